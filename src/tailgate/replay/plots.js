// The plots share the time axis; the number after a curve's name is its value at the playhead.
const buildPlots = (() => {
  const SVG = "http://www.w3.org/2000/svg";
  const HEIGHT = 150, SLIM = 70, TOP = 10, BOTTOM = 22, RIGHT = 10, LANE = 30, LANE_STEP = 50;
  const BELIEF = "#7a2a6b", EGO = "#0072b2", LEADER = "#4d4d4d", TRUTH = "#1a1a1a", DESIRED = "#00694b", ATTACK = "#b34700";
  // by number of the kind: colour and pattern, so that each alone suffices
  const LOOKS = {
    1: ["#b34700", "cross"], 2: ["#0072b2", "across"], 3: ["#00694b", "dashes"], 4: ["#4d4d4d", "dots"], 5: ["#7a2a6b", "rising"],
    6: ["#8a5a00", "falling"], 7: ["#1a1a1a", "upright"], 8: ["#a3003c", "specks"], 9: ["#00606b", "waves"], 10: ["#4b2e83", "corners"],
  };
  const PATTERNS = {
    cross: "M0 0 8 8M8 0 0 8", across: "M0 2H8M0 6H8", dashes: "M0 2H5M4 6H8M0 6H1", dots: "M1 2h2M5 6h2", rising: "M-2 2 2-2M0 8 8 0M6 10 10 6",
    falling: "M-2 6 2 10M0 0 8 8M6-2 10 2", upright: "M2 0V8M6 0V8", specks: "M1 1h1M5 2h1M3 4h1M7 5h1M1 6h1M5 7h1", waves: "M0 4 2 1 4 4 6 7 8 4",
    corners: "M1 3V1H3M5 7H7V5",
  };

  const make = (name, attributes = {}, parent = null, words = null) => {
    const node = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    if (words !== null) node.textContent = words;
    if (parent) parent.append(node);
    return node;
  };
  const html = (name, parent = null, words = null, className = "") => {
    const node = document.createElement(name);
    if (words !== null) node.textContent = words;
    if (className) node.className = className;
    if (parent) parent.append(node);
    return node;
  };
  const minus = (words) => String(words).replace(/-/g, "−");
  const short = (x) => (x === null || x === undefined ? "–" : minus(Math.abs(x) >= 1e5 || (x && Math.abs(x) < 1e-3) ? String(Number(x.toPrecision(2)).toExponential()).replace("e+", "e") : +x.toPrecision(4)));
  const fixed = (x, digits) => (x === null || x === undefined ? "–" : Math.abs(x) >= 1e5 ? short(x) : minus(x.toFixed(x && digits && Math.abs(x) < 0.95 ? 2 : digits)));

  const niceStep = (span, most) => {
    const raw = span / most, unit = 10 ** Math.floor(Math.log10(raw));
    return unit * [1, 2, 2.5, 5, 10].find((m) => raw <= m * unit * (1 + 1e-9));
  };
  const niceTicks = (low, high, most) => {
    const step = niceStep(high - low || 1, most), out = [];
    for (let i = Math.ceil(low / step - 1e-9); i <= Math.floor(high / step + 1e-9); i += 1) out.push(+(i * step).toPrecision(12));
    return out;
  };
  const extent = (lists) => {
    let low = Infinity, high = -Infinity;
    for (const list of lists) for (const v of list) if (v !== null) {
      if (v < low) low = v;
      if (v > high) high = v;
    }
    return low <= high ? [low, high] : [0, 1];
  };
  // [first, last] steps of the runs in which `on(step)` holds
  const runsOf = (length, on) => {
    const out = [];
    for (let s = 1; s <= length; s += 1) {
      if (!on(s)) continue;
      if (out.length && out[out.length - 1][1] === s - 1) out[out.length - 1][1] = s;
      else out.push([s, s]);
    }
    return out;
  };

  const patterns = () => {
    const holder = make("svg", { width: 0, height: 0, "aria-hidden": "true", class: "sr" }), defs = make("defs", {}, holder);
    for (const [kind, [ink, name]] of Object.entries(LOOKS)) {
      const tile = make("pattern", { id: `kind-${kind}`, width: 8, height: 8, patternUnits: "userSpaceOnUse" }, defs);
      make("rect", { width: 8, height: 8, fill: ink, "fill-opacity": 0.22 }, tile);
      make("path", { d: PATTERNS[name], stroke: ink, "stroke-width": name === "dots" ? 2 : 1.2, fill: "none" }, tile);
    }
    const tile = make("pattern", { id: "attacked", width: 6, height: 6, patternUnits: "userSpaceOnUse" }, defs);
    make("rect", { width: 6, height: 6, fill: ATTACK, "fill-opacity": 0.06 }, tile);
    make("path", { d: "M-1 1 1-1M0 6 6 0M5 7 7 5", stroke: ATTACK, "stroke-opacity": 0.3, "stroke-width": 1 }, tile);
    return holder;
  };

  // inks and dashes of the curves of many agents
  const INKS = [TRUTH, EGO, DESIRED, BELIEF, "#8a5a00", LEADER], DASHES = ["none", "7 4", "2 3", "10 3 2 3"];

  // a single agent: everything; several: the plots of all (part "all") or of one of them (part "one")
  return (box, episode, seek, part = "") => {
    const { dt, length, road, believed, errors, wires, kinds, radar } = episode;
    const age = radar && dt > 0.5 ? 0 : 1, of = age ? "" : " (of this time)"; // with long steps, an estimate is drawn at the time of its measurement
    const end = Math.max(length, 1) * dt, digits = dt >= 0.1 ? 1 : dt >= 0.01 ? 2 : 3;
    const attacked = runsOf(length, (s) => episode.kind[s - 1] !== 0);
    const alarms = runsOf(length, (s) => episode.alarm[s - 1]);
    const hits = [episode.hit, episode.rear_hit].filter((step) => step !== null), panels = [];
    if (!document.getElementById("attacked")) document.body.append(patterns());

    // a panel: heading, keys with values, picture; `draw(svg, frame)` draws the picture at the present width
    const panel = (title, unit, height, draw, name) => {
      const figure = html("figure", box, null, "plot");
      figure.id = `plot-${name}`;
      const heading = html("h2", figure, title);
      if (unit) html("span", heading, ` [${unit}]`, "quiet");
      const keys = html("ul", figure, null, "keys"), svg = make("svg", { role: "img", "aria-label": `${title}${unit ? ` in ${unit}` : ""} against time in seconds` }, figure);
      const one = { svg, keys, height, draw, outputs: [], playhead: null, x: null };
      panels.push(one);
      return one;
    };
    const key = (one, curve, value) => {
      const item = html("li", one.keys), sample = make("svg", { "aria-hidden": "true" }, item);
      make("line", { x1: 0, x2: 28, y1: 6, y2: 6, stroke: curve.ink, "stroke-width": curve.thick || 2, "stroke-dasharray": curve.dash || "none" }, sample);
      html("span", item, curve.name);
      if (value) one.outputs.push([html("output", item), value]);
    };
    const note = (one, words) => html("li", one.keys, words, "note");

    const base = (one, width) => {
      // the frame, the time axis, and the parts common to all panels
      const left = parseFloat(getComputedStyle(box).getPropertyValue("--left")) * 16, bottom = one.height - BOTTOM;
      const x = (t) => left + (t / end) * (width - left - RIGHT);
      one.svg.replaceChildren();
      one.svg.setAttribute("viewBox", `0 0 ${width} ${one.height}`);
      one.svg.setAttribute("height", one.height);
      for (const t of niceTicks(0, end, Math.max(4, Math.floor(width / 80)))) {
        make("line", { class: "grid", x1: x(t), x2: x(t), y1: TOP, y2: bottom }, one.svg);
        const last = x(t) > width - 24; // such a label would leave the picture
        make("text", { x: last ? width - 1 : x(t), y: bottom + 15, "text-anchor": last ? "end" : "middle" }, one.svg, `${minus(t)} s`);
      }
      for (const [a, b] of attacked) {
        const from = x(Math.max(0, (a - 0.5) * dt)), to = x(Math.min(end, (b + 0.5) * dt));
        make("rect", { x: from, y: TOP, width: Math.max(1, to - from), height: bottom - TOP, fill: "url(#attacked)" }, one.svg);
      }
      one.x = x;
      one.left = left;
      return { x, left, bottom, width, right: width - RIGHT };
    };
    const finish = (one, frame) => {
      make("line", { class: "frame", x1: frame.left, x2: frame.right, y1: frame.bottom, y2: frame.bottom }, one.svg);
      make("line", { class: "frame", x1: frame.left, x2: frame.left, y1: TOP, y2: frame.bottom }, one.svg);
      for (const step of hits) make("line", { class: "end", x1: frame.x(step * dt), x2: frame.x(step * dt), y1: TOP - 4, y2: frame.bottom }, one.svg);
      one.playhead = make("line", { class: "playhead", y1: TOP - 6, y2: frame.bottom, x1: 0, x2: 0 }, one.svg);
    };
    // minimum and maximum of every pixel column, so that no peak is lost
    const path = (values, offset, x, y) => {
      let d = "", column = null, group = [];
      const flush = () => {
        if (!group.length) return;
        const ys = group.map(([, v]) => v), low = Math.min(...ys), high = Math.max(...ys);
        const points = group.length > 4 ? [group[0], ...(ys.indexOf(low) < ys.indexOf(high) ? [[column, low], [column, high]] : [[column, high], [column, low]]), group[group.length - 1]] : group;
        for (const [px, v] of points) d += `${d && !d.endsWith(" ") ? "L" : "M"}${px.toFixed(1)},${v.toFixed(1)}`;
        group = [];
      };
      values.forEach((v, i) => {
        if (v === null) {
          flush();
          if (d && !d.endsWith(" ")) d += " ";
          return;
        }
        const px = x((i + offset) * dt);
        if (Math.floor(px) !== column) flush();
        column = Math.floor(px);
        group.push([px, y(v)]);
      });
      flush();
      return d;
    };

    // curves over a linear or logarithmic axis; core curves set the range, the others may leave it
    const chart = (name, title, unit, curves, options = {}) => {
      const core = curves.filter((c) => !c.wild), lists = core.map((c) => c.values);
      let [low, high] = extent(options.include ? [...lists, options.include] : lists);
      let [least, most] = extent(curves.map((c) => c.values));
      const room = 0.35 * Math.max(high - low, options.least || 0), off = curves.filter((c) => c.wild && extent([c.values]).some((v) => v < low - room || v > high + room));
      low = Math.max(Math.min(low, least), low - room);
      high = Math.min(Math.max(high, most), high + room);
      const pad = 0.06 * Math.max(high - low, options.least || 1e-9);
      if (!options.log) [low, high] = [low - pad, high + pad];
      const one = panel(title, unit, options.height || HEIGHT, (self, width) => {
        const frame = base(self, width), tall = frame.bottom - TOP;
        const scaled = options.log ? (v) => Math.log10(Math.max(v, options.floor)) : (v) => v;
        const bottom = scaled(options.log ? options.floor : low), top = options.log ? Math.log10(high) + 0.1 : high;
        const y = (v) => frame.bottom - ((scaled(v) - bottom) / (top - bottom || 1)) * tall;
        const clip = `clip-${name}`, area = make("clipPath", { id: clip }, make("defs", {}, self.svg));
        make("rect", { x: frame.left, y: TOP - 1, width: frame.right - frame.left, height: tall + 2 }, area);
        let ticks = niceTicks(low, high, (options.height || HEIGHT) > 100 ? 5 : 3);
        if (options.log) {
          const decades = niceTicks(Math.ceil(bottom), top, 5).filter(Number.isInteger);
          ticks = decades.length > 1 ? decades.map((e) => 10 ** e) : niceTicks(10 ** bottom, 10 ** top, 4).filter((v) => v > 0);
        }
        for (const tick of ticks) {
          make("line", { class: tick === 0 ? "zero" : "grid", x1: frame.left, x2: frame.right, y1: y(tick), y2: y(tick) }, self.svg);
          make("text", { x: frame.left - 6, y: y(tick) + 4, "text-anchor": "end" }, self.svg, short(tick));
        }
        const inside = make("g", { "clip-path": `url(#${clip})` }, self.svg);
        for (const curve of curves) {
          make("path", { class: "curve", d: path(curve.values, curve.offset, frame.x, y), stroke: curve.ink, "stroke-width": curve.thick || 2, "stroke-dasharray": curve.dash || "none" }, inside);
        }
        if (options.over) options.over(self, frame, y);
        finish(self, frame);
      }, name);
      for (const curve of curves) key(one, curve, curve.level ? null : (s) => (curve.short ? short(curve.values[s - curve.offset]) : fixed(curve.values[s - curve.offset], curve.digits ?? 1)));
      for (const curve of off) {
        const [a, b] = extent([curve.values]);
        note(one, `${curve.name} leaves the plot: ${short(a)} to ${short(b)} ${unit}`);
      }
      return one;
    };

    const collisions = (self, frame) => hits.forEach((step) => {
      const at = frame.x(step * dt), before = at - frame.left > 100, words = step === episode.hit ? (episode.lane ? "off the lane" : "collision") : "rear collision";
      make("text", { class: "mark", x: at + (before ? -5 : 5), y: TOP + 10, "text-anchor": before ? "end" : "start" }, self.svg, words);
    });
    if (part === "all") {
      const many = (lists, offset, digits) => Object.entries(lists).map(([i, values], place) => ({
        name: `${episode.noun} ${i}`, values, offset, digits, ink: INKS[place % INKS.length], dash: DASHES[Math.floor(place / INKS.length) % DASHES.length], thick: 1.8,
      }));
      if (episode.string) {
        const followers = Object.fromEntries(Object.keys(episode.sizes).filter((i) => episode.agents[i].road).map((i) => [i, episode.string.gap[i]]));
        chart("gaps", "Gap of each car to the one ahead", "m", many(followers, 0, 1), { include: [0], least: 5, height: 190, over: collisions });
        const sizes = Object.fromEntries(Object.entries(episode.sizes).filter(([i]) => i in followers));
        chart("sizes", "Size of the error of each car's believed gap", "m", many(sizes, 1, 2), { include: [0], least: 1, height: 150 });
      } else {
        const found = Object.values(episode.sizes).flat().filter((v) => v > 0), top = Math.max(...found, 1e-9);
        const bottom = 10 ** Math.floor(Math.log10(Math.max(Math.min(...found, top), 1e-6 * top)));
        const lines = many(episode.sizes, 1, 3).map((one) => ({ ...one, short: true }));
        const one = chart("sizes", "Error of each agent's estimate, 2-norm, logarithmic", "-", lines, { log: true, floor: bottom, height: 220 });
        if (Math.min(...Object.values(episode.sizes).flat()) < bottom) note(one, `below ${short(bottom)}: drawn at the lower edge`);
      }
    }
    if (part !== "all" && road) chart("gap", episode.lane ? "Distance to the nearer line" : "Gap to the car ahead", "m", [
      { name: "true", values: road.gap, offset: 0, ink: TRUTH, thick: 2.5 },
      { name: `believed${of}`, values: believed.gap, offset: age, ink: BELIEF, dash: "6 4", wild: true },
      { name: episode.lane ? "in the middle" : "desired at the true speed", values: episode.desired, offset: 0, ink: DESIRED, dash: "2 3" },
    ], {
      include: [0], least: episode.lane ? 1 : 5, height: 190,
      over: collisions,
    });
    if (part !== "all" && road && !episode.lane) chart("speed", "Speed", "m/s", [
      { name: part ? `car ${episode.number}` : "ego", values: road.speed, offset: 0, ink: EGO, thick: 2.5, digits: 2 },
      { name: "ahead", values: road.lead_speed, offset: 0, ink: LEADER, dash: "10 3 2 3", digits: 2 },
      { name: `believed own${of}`, values: believed.speed, offset: age, ink: BELIEF, dash: "6 4", wild: true, digits: 2 },
    ], { include: [0], least: 2 });
    if (part !== "all") for (const { name, title, unit, least, values } of errors) {
      chart(name, title, unit, [{ name: "estimate less truth", values, offset: 1, ink: BELIEF, digits: 2 }], { include: [0], least, height: 130 });
    }

    if (part !== "all" && radar && radar.muted.includes(1)) drawChallenges();
    function drawChallenges() {
      // a dot for each challenge, filled above the threshold
      const { muted, energy, threshold } = radar, heard = energy.map((v, i) => (muted[i] ? v : null)), loud = (v) => threshold !== null && v > threshold;
      const curves = [{ name: "heard at a challenge", values: heard, offset: 1, ink: TRUTH, digits: 2 }];
      if (threshold !== null) curves.push({ name: `threshold of the defence = ${short(threshold)} dB`, values: Array(length).fill(threshold), offset: 1, ink: ATTACK, dash: "7 4", level: true });
      const one = chart("radar", "Energy that the silent radar hears, over its own noise", "dB", curves, {
        include: [0], least: 3, height: 130,
        over: (self, frame, y) => heard.forEach((v, i) => {
          if (v !== null) make("circle", { cx: frame.x((i + 1) * dt), cy: y(v), r: 3.5, fill: loud(v) ? TRUTH : "#fff", stroke: TRUTH, "stroke-width": 1.5 }, self.svg);
        }),
      });
      const all = heard.filter((v) => v !== null), above = all.filter(loud).length;
      note(one, `${all.length} ${all.length === 1 ? "challenge" : "challenges"}${threshold === null ? "" : `, ${above} above the threshold (filled)`}`);
    }

    // score, threshold or gate, alarm
    const modes = part === "all" ? [] : runsOf(length, (s) => episode.mode[s - 1] !== 0);
    if (part !== "all") drawScore();
    function drawScore() {
      const limit = episode.threshold;
      const scores = [{ name: "score", values: episode.score, offset: 1, ink: TRUTH, thick: 1.5, digits: 2 }];
      const bar = limit ? Array(length).fill(limit.value) : null;
      if (bar) scores.push({ name: `threshold ${limit.name} = ${short(limit.value)}`, values: bar, offset: 1, ink: ATTACK, dash: "7 4", level: true });
      if (episode.gate) scores.push({ name: "gate", values: episode.gate, offset: 1, ink: ATTACK, dash: "7 4", digits: 2 });
      const positive = episode.score.filter((v) => v > 0).sort((a, b) => a - b), middle = positive[Math.floor(positive.length / 2)] || 1;
      const [least, most] = extent([episode.score]);
      const log = least >= 0 && most > 30 * Math.max(middle, limit ? limit.value / 10 : 0);
      const floor = 10 ** Math.floor(Math.log10(middle) - 1.5);
      const score = chart("score", log ? "Score of the defence, logarithmic" : "Score of the defence", "-", scores, {
        include: [0], least: 1e-3, log, floor, height: 170,
        over: (self, frame) => {
          for (const [a, b] of alarms) {
            const from = frame.x(Math.max(0, (a - 0.5) * dt)), to = frame.x(Math.min(end, (b + 0.5) * dt));
            make("rect", { x: from, y: TOP - 8, width: Math.max(1.5, to - from), height: 8, fill: TRUTH, class: "alarm" }, self.svg);
          }
        },
      });
      const count = episode.alarm.reduce((a, b) => a + b, 0);
      if (count) {
        const sign = html("li", score.keys), swatch = make("svg", { "aria-hidden": "true" }, sign);
        make("rect", { x: 4, y: 2, width: 20, height: 8, fill: TRUTH }, swatch);
        html("span", sign, `alarm, at the upper edge: ${count} ${count === 1 ? "step" : "steps"}, ${alarms.length} ${alarms.length === 1 ? "onset" : "onsets"}`);
      } else note(score, "no alarm in this episode");
      if (log) note(score, `below ${short(floor)}: drawn at the lower edge`);
      if (limit && !limit.rules) note(score, "this defence's alarm does not follow from the threshold alone");
      if (!limit && !episode.gate) note(score, "no threshold declared");
    }

    if (episode.control && part !== "all") {
      const commands = [{ name: "commanded", values: episode.control, offset: 1, ink: TRUTH, digits: 2 }];
      if (episode.applied) commands.push({ name: "applied (attacked)", values: episode.applied, offset: 1, ink: ATTACK, dash: "6 4", digits: 2 });
      const control = chart("control", ...(episode.lane ? ["Commanded steering angle", "rad"] : ["Commanded acceleration", "m/s²"]), commands, { include: [0], least: episode.lane ? 0.01 : 1, height: 130 });
      if (!episode.applied) note(control, "applied as commanded throughout");
    }

    // lanes of decisions: one for each wire and kind, for refused commands, and for modes other than normal
    const lanes = [];
    for (const wire of wires) for (const kind of wire.kinds) {
      const { valued, unit } = kinds[kind], on = (s) => wire.hit[s - 1] && episode.kind[s - 1] === kind;
      const values = wire.value ? wire.value.map((v, i) => (on(i + 1) ? v : null)) : [], [low, high] = extent([values]), of = unit || wire.unit;
      const size = !valued || !wire.value ? "" : low === high ? `, ${short(low)} ${of}` : `, ${short(low)} to ${short(high)} ${of}`;
      lanes.push({ name: `${wire.name}: ${kinds[kind].code}${size}`, runs: runsOf(length, on), fill: `url(#kind-${kind})`, ink: LOOKS[kind][0], values: valued && wire.value ? values : null, low, high });
    }
    const refused = runsOf(length, (s) => episode.refused[s - 1]);
    if (refused.length) lanes.push({ name: `refused commands: ${episode.refused.reduce((a, b) => a + b, 0)}`, runs: refused, fill: TRUTH, ink: TRUTH });
    if (part !== "one") {
      const attack = panel("Attack", "", TOP + BOTTOM + Math.max(1, lanes.length) * LANE_STEP, (self, width) => drawLanes(self, width, lanes, "No attack took effect in this episode."), "attack");
      for (const kind of [...new Set(wires.flatMap((w) => w.kinds))].sort()) {
        const item = html("li", attack.keys), sample = make("svg", { "aria-hidden": "true" }, item);
        make("rect", { width: 28, height: 12, fill: `url(#kind-${kind})`, stroke: LOOKS[kind][0] }, sample);
        html("span", item, `${kinds[kind].code}: ${kinds[kind].name}, ${kinds[kind].does}`);
      }
    }
    if (modes.length) {
      const shown = [...new Set(episode.mode)].filter((m) => m).sort();
      const rows = shown.map((m) => ({ name: episode.modes[m], runs: runsOf(length, (s) => episode.mode[s - 1] === m), fill: "url(#kind-4)", ink: LEADER }));
      panel("Mode that the defence asks for, other than NORMAL", "", TOP + BOTTOM + rows.length * LANE_STEP, (self, width) => drawLanes(self, width, rows, ""), "mode");
    }
    function drawLanes(self, width, rows, none) {
      const frame = base(self, width);
      if (!rows.length) make("text", { x: frame.left + 8, y: TOP + 22, class: "lanename" }, self.svg, none);
      rows.forEach((lane, i) => {
        const top = TOP + i * LANE_STEP + 18;
        make("rect", { class: "lane", x: frame.left, y: top, width: frame.right - frame.left, height: LANE }, self.svg);
        make("text", { class: "lanename", x: frame.left + 2, y: top - 5 }, self.svg, lane.name);
        const span = Math.max(Math.abs(lane.low || 0), Math.abs(lane.high || 0)) || 1, below = lane.low < 0, above = lane.high > 0 || !below;
        const y = (v) => top + 1 + (LANE - 2) * (above && below ? 0.5 - (0.5 * v) / span : above ? 1 - v / span : -v / span);
        if (lane.values) {
          const ends = above && below ? [span, -span] : above ? [span, 0] : [0, -span];
          ends.forEach((v, j) => make("text", { class: "scale", x: frame.left - 6, y: top + (j ? LANE - 1 : 9), "text-anchor": "end" }, self.svg, short(+v.toPrecision(3))));
        }
        for (const [a, b] of lane.runs) {
          const from = frame.x(Math.max(0, (a - 0.5) * dt)), to = frame.x(Math.min(end, (b + 0.5) * dt)), wide = Math.max(1.5, to - from);
          make("rect", { class: "hit", x: from, y: top, width: wide, height: LANE, fill: lane.fill, stroke: lane.ink, "stroke-width": wide > 4 ? 1 : 0 }, self.svg);
          if (lane.values) {
            // the value of every step
            let d = "";
            for (let s = a; s <= b; s += 1) {
              const v = y(lane.values[s - 1]).toFixed(1);
              d += `${d ? "L" : "M"}${(s === a ? from : frame.x((s - 0.5) * dt)).toFixed(1)},${v}H${(s === b ? from + wide : frame.x((s + 0.5) * dt)).toFixed(1)}`;
            }
            make("path", { class: "curve value", d, stroke: lane.ink, "stroke-width": 2 }, self.svg);
          }
        }
      });
      finish(self, frame);
    }
    if (episode.left && part !== "one") {
      const left = [episode.budget, ...episode.left.slice(1)];
      chart("budget", "Attack steps left", "steps", [{ name: `of ${episode.budget}`, values: left, offset: 0, ink: ATTACK, digits: 0 }], { include: [0], least: 1, height: SLIM + 20 });
    }

    let width = 0, now = 0;
    const place = (one) => {
      const at = one.x(now * dt);
      one.playhead.setAttribute("x1", at);
      one.playhead.setAttribute("x2", at);
    };
    const fit = () => {
      const fresh = Math.floor(box.clientWidth);
      if (!fresh || fresh === width) return;
      width = fresh;
      for (const one of panels) {
        one.draw(one, width);
        place(one);
      }
    };
    for (const one of panels) {
      const move = (event) => {
        const { left } = one.svg.getBoundingClientRect();
        seek(Math.round(((event.clientX - left - one.left) / (width - one.left - RIGHT)) * end / dt));
      };
      one.svg.addEventListener("pointerdown", (event) => {
        if (event.button) return;
        one.svg.setPointerCapture(event.pointerId);
        move(event);
      });
      one.svg.addEventListener("pointermove", (event) => {
        if (event.buttons & 1) move(event);
      });
    }
    const observer = new ResizeObserver(fit);
    observer.observe(box);
    fit();
    return {
      digits, attacked, alarms, short,
      stop: () => observer.disconnect(),
      show: (s) => {
        now = s;
        for (const one of panels) {
          if (one.x) place(one);
          for (const [output, value] of one.outputs) output.textContent = value(s);
        }
      },
    };
  };
})();
