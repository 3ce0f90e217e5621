// The road of one car at one step, drawn as tailgate.envs.render_following draws it: gaps between bumpers are to scale, cars are not.
const drawRoad = (() => {
  const SPANS = [15, 30, 60, 120, 240, 480]; // metres ahead: few and fixed, so that the scale does not jitter
  const { INK, GREY, WHITE, LEADER, EGO, HUMAN, BELIEF, BELIEF_PALE, FAR } = PEN;

  return (canvas, episode, s) => {
    const tools = makePen(canvas);
    if (!tools) return;
    const { pen, width, height, narrow, margin, small, large, metres, clamp, line, text, head, span, drawCar, burst, sign } = tools;

    const car = clamp(width * 0.0875, 46, 84), tall = car * 0.405;
    const nose = Math.round(width * (narrow ? 0.46 : 0.42)), tail = nose - car, ahead = width - margin - car - nose, behind = tail - car - margin;
    const strip = Math.round(height * 0.56), trueLine = Math.round(strip * 0.35), wheels = Math.round(strip * (narrow ? 0.65 : 0.63)), roadHeight = narrow ? 10 : 14;
    const believedLine = Math.round(strip + (height - strip) * (narrow ? 0.5 : 0.45)), ghostWheels = Math.round(height - 0.22 * (height - strip));

    const vehicle = (x, ink, name, speed, room) => {
      // a car with its name and speed, or an arrow at the edge if it is outside
      const way = x > width - margin + 1 ? 1 : x < margin + car - 1 ? -1 : 0;
      const middle = way ? (way > 0 ? width - margin : margin) : x - car / 2;
      if (way) head(middle, wheels - tall / 2, way, ink, car * 0.19);
      else drawCar(x, wheels, ink, false, car);
      text(middle, wheels + roadHeight + small + 2, name + (way ? (narrow ? ", far" : " (out of view)") : ""), { ink, anchor: "m", room, ground: WHITE });
      text(middle, wheels + roadHeight + 2 * small + 5, `${speed.toFixed(1)} m/s`, { ink, anchor: "m", bold: true, room, ground: WHITE });
    };
    const crash = (x, words, from, to) => {
      burst(x, wheels - tall / 2, 0.29 * car);
      sign(x, trueLine, words, from, to);
    };

    const { road, believed, radar } = episode, rear = episode.rear && episode.rear.rear_gap[s] !== null ? episode.rear : null; // in traffic there may be no car behind
    const shown = (x) => (radar ? Math.max(x, 0) : x); // a long step ends metres beyond a collision
    const gap = shown(road.gap[s]), rearGap = rear ? shown(rear.rear_gap[s]) : Infinity;
    const first = SPANS.findIndex((metre) => gap <= metre), from = first < 0 ? SPANS.length - 1 : first;
    const scales = SPANS.slice(from, from + 2).map((metre) => ahead / metre);
    const scale = scales.find((each) => rearGap * each <= behind) ?? scales[0];
    const leader = nose + gap * scale, lane = ahead / 6;

    // the belief
    const belief = s ? believed.gap[s - 1] : null, off = radar && s ? radar.then[s - 1] - belief : gap - belief; // at the time of the measurement
    pen.fillStyle = BELIEF_PALE;
    pen.fillRect(0, strip, width, height - strip);
    line(0, strip, width, strip, BELIEF, 1);
    line(0, ghostWheels, width, ghostWheels, BELIEF, 1, [3, 3]);
    if (belief !== null) {
      const ghost = clamp(nose + off * scale, -FAR, FAR);
      line(leader, trueLine, leader, ghostWheels, LEADER, 1, [3, 3]); // the same bumper in both strips
      const middle = span(ghost, leader, believedLine, BELIEF, [5, 5]);
      text(middle, believedLine - 9, `believed gap ${metres(belief)}${radar ? ` (true then: ${metres(radar.then[s - 1])})` : ""}`, { ink: BELIEF, size: large, anchor: "m", bold: true, room: [margin, width - margin], ground: BELIEF_PALE });
      if (ghost > 0 && ghost - car < width) drawCar(ghost, ghostWheels, BELIEF, true, car);
      else {
        const way = ghost > 0 ? 1 : -1, x = way > 0 ? width - margin : margin, y = ghostWheels - tall / 2;
        head(x, y, way, BELIEF, 18);
        text(x - way * 24, y + 5, `out of view: ${metres(Math.abs(off))} ${way > 0 ? "ahead of" : "behind"} where it really is`,
          { ink: BELIEF, anchor: way > 0 ? "r" : "l", room: [margin + 24, width - margin - 24], ground: BELIEF_PALE });
      }
    } else {
      const first = radar && episode.dt > 0.5 && believed.gap.length; // the plots show it at this time
      const words = first ? `this gap is measured in step 1, and then believed to be ${metres(believed.gap[0])}` : "nothing is measured before step 1";
      text(width / 2, believedLine, words, { ink: BELIEF, anchor: "m", room: [margin, width - margin] });
    }
    text(margin, strip + small + 4, "WHERE THE EGO BELIEVES IT IS", { ink: BELIEF, room: [margin, width - margin], ground: BELIEF_PALE });
    span(margin, margin + lane, height - 8, GREY);
    text(margin + lane + 8, height - 4, `${+(lane / scale).toFixed(2)} m`, { ink: GREY });

    if (radar && s) {
      const muted = radar.muted[s - 1], level = radar.energy[s - 1].toFixed(1).replace("-", "−");
      const words = muted ? `CHALLENGE${narrow ? "" : ": radar silent"}, heard ${level} dB` : `radar ${narrow ? "on" : "transmits"}`;
      text(width - margin, height - 4, words, { ink: INK, anchor: "r", bold: Boolean(muted), room: [margin + lane + (narrow ? 50 : 80), width - margin] });
      if (!muted && !(s === episode.hit)) for (const radius of [10, 17, 24]) { // the probe
        let from = null;
        for (let turn = -2; turn <= 2; turn += 1) {
          const angle = turn * 0.35, to = [nose + radius * Math.cos(angle), wheels - tall / 2 + radius * Math.sin(angle)];
          if (from) line(...from, ...to, EGO, 1.5);
          from = to;
        }
      }
    }

    // the truth
    text(margin, small + 4, "THE ROAD AS IT IS", { ink: GREY });
    pen.fillStyle = LEADER;
    pen.fillRect(0, wheels, width, roadHeight);
    pen.fillStyle = WHITE;
    const shift = ((-(road.position[s] * scale) % lane) + lane) % lane;
    for (let x = shift - lane; x < width; x += lane) pen.fillRect(x, wheels + roadHeight / 2 - 1, lane / 2, 2);
    const behindHit = rear && rearGap <= 0, frontHit = gap <= 0 || (s > 0 && s === episode.hit);
    if (rear) vehicle(tail - rearGap * scale, HUMAN, "behind", rear.rear_speed[s], [margin, tail - 4]);
    vehicle(leader + car, LEADER, "ahead", road.lead_speed[s], [nose + 5, width - margin]);
    vehicle(nose, EGO, "ego", road.speed[s], [tail, nose]);
    const edge = tail + car / 4; // keeps the texts apart where both gaps are small
    if (behindHit) crash(tail, "REAR COLLISION", 2, nose - margin);
    else if (rear) {
      const middle = span(tail, tail - rearGap * scale, trueLine, HUMAN);
      text(middle, trueLine - 9, `${narrow ? "behind" : "gap behind"} ${metres(rearGap)}`, { ink: HUMAN, anchor: "m", room: [margin, edge] });
    }
    if (frontHit) crash(nose, "COLLISION", behindHit ? nose + 2 : rear ? edge + 4 : 2, width - 2);
    else {
      const middle = span(nose, leader, trueLine, INK);
      text(middle, trueLine - 9, `true gap ${metres(gap)}`, { size: large, anchor: "m", bold: true, room: [behindHit ? nose + 4 : edge + margin, width - margin] });
    }
  };
})();
