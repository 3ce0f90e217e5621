// The player: the playhead, the words for its step, and the keys.
(() => {
  const episode = JSON.parse(document.getElementById("episode").textContent);
  const at = (id) => document.getElementById(id);
  const { dt, length } = episode;
  const slider = at("slider"), canvas = at("road"), playButton = at("play"), speedMenu = at("speed");
  let now = -1, playing = false, last = 0, carry = 0;

  const seek = (s) => {
    halt();
    show(s);
  };
  // one agent: all plots. Several: plots of all, and plots of the selected one
  const many = Boolean(episode.agents), drawScene = episode.graph ? drawGraph : episode.lane ? drawLane : many ? drawString : drawRoad;
  const together = many ? buildPlots(at("together"), episode, seek, "all") : null;
  let agent = many ? episode.agent : 0, plots = null;
  const choose = (number) => {
    if (plots) plots.stop();
    agent = number;
    at("plots").replaceChildren();
    plots = buildPlots(at("plots"), many ? { ...episode, ...episode.agents[agent], number: agent } : episode, seek, many ? "one" : "");
    if (now >= 0) plots.show(now);
    drawScene(canvas, episode, Math.max(now, 0), agent);
  };
  choose(agent);
  const { digits, attacked, alarms, short } = together || plots;

  const words = (s) => {
    // the command that took effect in step s
    const kind = s ? episode.kind[s - 1] : 0;
    if (!kind) return ["No attack", s ? "every wire arrives as it was sent" : "before the first step"];
    const { name, does, valued, unit } = episode.kinds[kind];
    const hit = episode.wires.filter((wire) => wire.hit[s - 1]);
    const list = hit.map((wire) => (valued && wire.value ? `${wire.name} ${kind === 5 && wire.value[s - 1] > 0 ? "+" : ""}${short(wire.value[s - 1])} ${unit || wire.unit}` : wire.name));
    return [`ATTACK: ${name}`, `${list.join(", ")} (${does})`];
  };

  // the smallest gap at a step, or the largest error without a road
  const worst = (s) => {
    if (episode.graph) return s ? Math.max(...episode.graph.error.map((values) => values[s - 1])) : 0;
    return episode.string ? Math.min(...episode.string.gap.map((values) => values[s]).filter((gap) => gap !== null)) : episode.road.gap[s];
  };

  const show = (s) => {
    s = Math.max(0, Math.min(s, length));
    if (s === now) return;
    now = s;
    const [title, does] = words(s), refused = s > 0 && episode.refused[s - 1], alarm = s > 0 && Boolean(episode.alarm[s - 1]);
    const own = many ? episode.agents[agent] : episode, mode = s ? own.mode[s - 1] : 0;
    const who = many && alarm ? episode.alarms[s - 1].flatMap((on, i) => (on ? [i] : [])) : [], whose = many ? ` of ${episode.noun} ${agent}` : "";
    const list = who.length > 6 ? `${who.length} ${episode.noun}s` : who.length ? `${episode.noun}${who.length > 1 ? "s" : ""} ${who.join(", ")}` : "";
    at("time").textContent = `t = ${(s * dt).toFixed(digits)} s`;
    at("when").textContent = `${(s * dt).toFixed(digits)} s`;
    at("step").textContent = `step ${s} of ${episode.horizon}`;
    at("attack").classList.toggle("on", s > 0 && episode.kind[s - 1] !== 0);
    at("attack").querySelector("b").textContent = title + (refused ? " (a command was refused)" : "");
    at("attack").querySelector("span").textContent = does;
    if (episode.left) at("budget").querySelector("b").textContent = `${episode.left[s]} of ${episode.budget}`;
    at("alarm").classList.toggle("on", alarm);
    at("alarm").querySelector("b").textContent = alarm ? "ALARM" : "no alarm";
    at("alarm").querySelector(".words span").textContent = [list, mode ? `mode${whose}: ${episode.modes[mode]}` : ""].filter(Boolean).join("; ");
    slider.value = s;
    const least = worst(s), shown = episode.graph ? `largest error ${s ? short(least) : "unknown"}` : `${many ? "smallest gap" : "gap"} ${short(least)} metres`;
    slider.setAttribute("aria-valuetext", `${(s * dt).toFixed(digits)} seconds, ${shown}, ${title}, ${alarm ? "alarm" : "no alarm"}`);
    drawScene(canvas, episode, s, agent);
    plots.show(s);
    if (together) together.show(s);
  };

  const halt = () => {
    playing = false;
    playButton.classList.remove("on");
    playButton.setAttribute("aria-label", "Play");
  };
  const tick = (time) => {
    if (!playing) return;
    carry += ((time - last) / 1000) * Number(speedMenu.value) / dt;
    last = time;
    const whole = Math.floor(carry);
    carry -= whole;
    show(now + whole);
    if (now >= length) halt();
    else requestAnimationFrame(tick);
  };
  const toggle = () => {
    if (playing) return halt();
    if (now >= length) show(0);
    playing = true;
    playButton.classList.add("on");
    playButton.setAttribute("aria-label", "Pause");
    requestAnimationFrame((time) => {
      last = time;
      carry = 0;
      tick(time);
    });
  };
  const go = (s) => {
    halt();
    show(s);
  };

  slider.max = length;
  slider.addEventListener("input", () => go(Number(slider.value)));
  at("back").addEventListener("click", () => go(now - 1));
  at("forth").addEventListener("click", () => go(now + 1));
  playButton.addEventListener("click", toggle);
  at("budget").hidden = !episode.left;
  const rates = [0.1, 0.25, 0.5, 1, 2, 4, 10], wanted = rates.find((rate) => (length * dt) / rate <= 40) ?? 10;
  for (const rate of rates) speedMenu.add(new Option(`${rate}×`, rate, false, rate === Math.max(wanted, 0.1)));

  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("select, .scroll")) return;
    const step = event.shiftKey ? 10 : 1;
    const moves = { ArrowLeft: now - step, ArrowDown: now - step, ArrowRight: now + step, ArrowUp: now + step, Home: 0, End: length };
    const vertical = event.key === "ArrowUp" || event.key === "ArrowDown" || event.key === "Home" || event.key === "End";
    if (event.key === " " && event.target.tagName !== "BUTTON") toggle();
    else if (event.key in moves && (!vertical || event.target === slider)) go(moves[event.key]); // otherwise these keys scroll the page
    else return;
    event.preventDefault();
  });

  const places = [["Start", 0]];
  if (attacked.length) places.push(["First attack", attacked[0][0]], ["Last attack step", attacked[attacked.length - 1][1]]);
  if (alarms.length) places.push(["First alarm", alarms[0][0]]);
  const course = [...Array(length + 1).keys()].map((s) => [worst(s), s]).filter(([value]) => value !== null);
  const way = episode.graph ? -1 : 1, [, extreme] = course.reduce((best, one) => (way * one[0] < way * best[0] ? one : best));
  places.push([episode.graph ? "Largest error" : episode.lane ? "Nearest to a line" : "Smallest gap", extreme]);
  if (episode.hit !== null) places.push([episode.lane ? "Off the lane" : "Collision", episode.hit]);
  if (episode.rear_hit !== null) places.push(["Rear collision", episode.rear_hit]);
  if (length !== episode.hit && length !== episode.rear_hit) places.push(["End", length]);
  for (const [name, s] of places) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = `${name}, ${(s * dt).toFixed(digits)} s`;
    button.addEventListener("click", () => go(s));
    at("jumps").append(button);
  }
  // attacks (lower) and alarms (upper) on the slider's track
  const marks = at("marks");
  marks.setAttribute("viewBox", `0 0 ${length || 1} 10`);
  marks.setAttribute("preserveAspectRatio", "none");
  for (const [runs, y, ink] of [[alarms, 0, "#1a1a1a"], [attacked, 5, "#b34700"]]) {
    for (const [a, b] of runs) {
      const bar = document.createElementNS("http://www.w3.org/2000/svg", "rect");
      const x = Math.max(0, a - 0.5), width = Math.max(Math.min(b + 0.5, length) - x, length / 300);
      for (const [name, value] of Object.entries({ x, y, width, height: 4, fill: ink, "shape-rendering": "crispEdges" })) bar.setAttribute(name, value);
      marks.append(bar);
    }
  }
  if (many) {
    const menu = at("agent");
    for (const number of Object.keys(episode.agents)) menu.add(new Option(`${episode.noun} ${number}`, number, false, Number(number) === agent));
    menu.addEventListener("change", () => choose(Number(menu.value)));
  }
  new ResizeObserver(() => drawScene(canvas, episode, now, agent)).observe(canvas);
  const named = Number.parseInt(location.hash.slice(1), 10); // page.html#290: from step 290 on
  show(Number.isNaN(named) ? (attacked[0]?.[0] ?? 0) : named);
})();
