// A platoon at one step, drawn as tailgate.envs.render_platoon draws it: the leader on the right, gaps to scale, cars not.
const drawString = (() => {
  const SPANS = [20, 40, 80, 160, 320, 640, 1280, 2560, 5120, 10240]; // metres of all gaps: few, so that the scale rests
  const { INK, GREY, WHITE, LEADER, EGO, BELIEF, BELIEF_PALE, ATTACK, FAR } = PEN;

  return (canvas, episode, s, agent) => {
    const tools = makePen(canvas);
    if (!tools) return;
    const { pen, width, height, margin, small, large, metres, clamp, font, line, fitted, text, head, span, drawCar, burst, sign, bolt, lamp } = tools;
    const { lead, position } = episode.string, led = lead ? 1 : 0; // led: the leader is no agent, and stands before them
    const before = (first, values) => (led ? [first, ...values] : values), empty = lead ?? [];
    const gaps = before(empty.map(() => null), episode.string.gap), speed = before(empty, episode.string.speed);
    const believed = before(empty.map(() => null), episode.string.believed), count = gaps.length, gap = gaps.map((values) => values[s]);
    const attacked = s ? before(0, episode.attacked[s - 1]) : gap.map(() => 0), alarmed = s ? before(0, episode.alarms[s - 1]) : gap.map(() => 0);
    const strip = Math.round(height * 0.56), trueLine = Math.round(strip * 0.3), wheels = Math.round(strip * 0.63), roadHeight = 10;
    const believedLine = strip + 24, ghostWheels = height - 30;

    // places: noses from the right
    const car = clamp((0.4 * (width - 2 * margin)) / count, 3, 56), tall = car * 0.405, room = width - 2 * margin - count * car;
    const total = gap.slice(1).reduce((sum, metre) => sum + Math.max(metre, 0), 0);
    const scale = room / (SPANS.find((metre) => total <= metre) ?? total), nose = [width - margin];
    for (let i = 1; i < count; i += 1) nose[i] = nose[i - 1] - car - gap[i] * scale;
    const wide = (words, size) => {
      pen.font = font(size, true);
      return pen.measureText(words).width;
    };
    // a dimension line, with its words where they fit or are needed
    const dimension = (x0, x1, y, words, ink, dash, must, up = true) => {
      const middle = span(x0, x1, y, ink, dash), fits = Math.abs(x1 - x0) - 4;
      const size = [small + 2, small, 9].find((each) => wide(words, each) <= fits) ?? (must ? small : 0);
      if (size) text(middle, up ? y - 7 : y + size + 2, words, { ink, size, anchor: "m", bold: true, room: [margin, width - margin] });
    };

    // the belief
    pen.fillStyle = BELIEF_PALE;
    pen.fillRect(0, strip, width, height - strip);
    line(0, strip, width, strip, BELIEF, 1);
    line(0, ghostWheels, width, ghostWheels, BELIEF, 1, [3, 3]);
    let level = 0, reached = FAR, told = false;
    for (let i = 1; i < count && s; i += 1) {
      const belief = believed[i][s - 1], tail = nose[i - 1] - car;
      if (belief === null) continue;
      const ghost = clamp(tail - belief * scale, -FAR, FAR);
      line(tail, trueLine, tail, ghostWheels, LEADER, 1, [3, 3]); // the same bumper in both strips
      level = Math.max(tail, ghost) > reached + 1 ? 1 - level : 0; // avoids overlapping lines
      reached = Math.min(tail, ghost);
      dimension(tail, ghost, believedLine + 18 * level, metres(belief), BELIEF, [5, 5], attacked[i], !level);
      if (ghost > 0 && ghost - car < width) drawCar(ghost, ghostWheels, BELIEF, true, car);
      else if (!told) {
        const way = ghost > 0 ? 1 : -1, x = way > 0 ? width - margin : margin;
        told = true;
        head(x, ghostWheels - 10, way, BELIEF, 16);
        text(x - way * 22, ghostWheels - 5, `car ${i - led} is out of view: ${metres(Math.abs(belief - gap[i]))} off`, { ink: BELIEF, anchor: way > 0 ? "r" : "l", room: [margin + 22, width - margin - 22], ground: BELIEF_PALE });
      }
    }
    if (!s) text(width / 2, believedLine + 14, "nothing is measured before step 1", { ink: BELIEF, anchor: "m" });
    const unit = [500, 200, 100, 50, 20, 10, 5, 2, 1].find((metre) => metre * scale < 0.13 * width) ?? 1;
    span(margin, margin + unit * scale, height - 10, GREY);
    text(margin + unit * scale + 8, height - 6, `${unit} m`, { ink: GREY });
    text(width - margin, height - 6, "WHERE EACH CAR BELIEVES IT IS", { ink: BELIEF, anchor: "r", room: [margin + unit * scale + 60, width - margin] });

    // the truth; the sign of a collision hides the words of the gaps behind it
    const hits = [...gap.keys()].filter((i) => i && gap[i] !== null && gap[i] <= 0);
    const behind = (x) => hits.some((i) => {
      const length = fitted(`COLLISION: car ${i - led}`, large, true, [0, FAR]) + 2 * margin;
      return Math.abs(x - clamp(nose[i], 2 + length / 2, width - 2 - length / 2)) < length / 2 + 2 * small;
    });
    text(margin, small + 4, "THE ROAD AS IT IS", { ink: GREY });
    pen.fillStyle = LEADER;
    pen.fillRect(0, wheels, width, roadHeight);
    pen.fillStyle = WHITE;
    const lane = width / 24, shift = ((-(position[s] * scale) % lane) + lane) % lane;
    for (let x = shift - lane; x < width; x += lane) pen.fillRect(x, wheels + roadHeight / 2 - 1, lane / 2, 2);
    const nearest = gap.indexOf(Math.min(...gap.filter((metre) => metre !== null)));
    for (let i = count - 1; i >= 0; i -= 1) {
      const ink = i === 0 ? LEADER : attacked[i] ? ATTACK : EGO, middle = nose[i] - car / 2;
      drawCar(nose[i], wheels, ink, false, car);
      const pitch = car + Math.min(i ? gap[i] : FAR, i + 1 < count ? gap[i + 1] : FAR) * scale;
      const name = i === 0 ? "leader" : `car ${i - led}`, short = wide(name, 9) < pitch ? name : String(i - led);
      if (wide(short, 9) < pitch) text(middle, wheels + roadHeight + small + 2, short, { ink, size: wide(short, small) < pitch ? small : 9, anchor: "m", bold: true, room: [2, width - 2], ground: WHITE });
      const moves = `${speed[i][s].toFixed(1)} m/s`;
      if (wide(moves, 9) < pitch) text(middle, wheels + roadHeight + 2 * small + 4, moves, { ink, size: wide(moves, small - 1) < pitch ? small - 1 : 9, anchor: "m", room: [2, width - 2], ground: WHITE });
      if (i === agent + led) line(nose[i] - car, wheels + roadHeight + 2, nose[i], wheels + roadHeight + 2, ink, 2); // the agent of the plots
      const size = clamp(car / 5, 4, 8), top = wheels - tall - 3, both = attacked[i] && alarmed[i] ? size : 0;
      if (attacked[i]) bolt(middle - both, top, size);
      if (alarmed[i]) lamp(middle + both, top - size, size);
      if (i && gap[i] > 0) dimension(nose[i - 1] - car, nose[i], trueLine, behind((nose[i] + nose[i - 1] - car) / 2) ? "" : metres(gap[i]), INK, [], i === nearest && car < 28);
    }
    hits.forEach((i) => {
      burst(nose[i], wheels - tall / 2, Math.max(10, car * 0.3));
      sign(nose[i], trueLine + 2, `COLLISION: car ${i - led}`, 2, width - 2);
    });
  };
})();
