"use strict";
// The road at one step, drawn as tailgate.envs.render draws it: gaps between bumpers are to scale, cars are not.
const drawRoad = (() => {
  const SPANS = [15, 30, 60, 120, 240, 480]; // metres ahead: few and fixed, so that the scale does not jitter
  const FAR = 1e6;
  const INK = "#1a1a1a", GREY = "#5f5f5f", WHITE = "#fff", GLASS = "#dcebf5";
  const LEADER = "#4d4d4d", EGO = "#0072b2", HUMAN = "#00805c", BELIEF = "#7a2a6b", BELIEF_PALE = "#f8eef5", WARNING = "#f0e442";
  const BODY = [[0, 0.18], [0, 0.6], [0.12, 0.64], [0.26, 1], [0.62, 1], [0.78, 0.62], [0.97, 0.54], [1, 0.18]];
  const WINDOW = [[0.2, 0.66], [0.3, 0.92], [0.59, 0.92], [0.7, 0.66]];
  const AXLES = [0.22, 0.78];
  const metres = (x) => {
    const digits = x && Math.abs(x) < 0.95 ? 2 : 1; // a gap that is not quite nothing shall not read as 0.0
    return `${x.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits }).replace("-", "−")} m`;
  };
  const clamp = (x, low, high) => Math.max(low, Math.min(x, high));

  return (canvas, episode, s) => {
    const width = canvas.clientWidth, height = canvas.clientHeight, ratio = window.devicePixelRatio || 1;
    if (!width) return;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);

    const narrow = width < 600;
    const margin = narrow ? 5 : 12, car = clamp(width * 0.0875, 46, 84), tall = car * 0.405, wheel = car * 0.09;
    const nose = Math.round(width * (narrow ? 0.46 : 0.42)), tail = nose - car, ahead = width - margin - car - nose, behind = tail - car - margin;
    const small = narrow ? 11 : 13, large = narrow ? 15 : 20;
    const strip = Math.round(height * 0.56), trueLine = Math.round(strip * 0.35), wheels = Math.round(strip * (narrow ? 0.65 : 0.63)), roadHeight = narrow ? 10 : 14;
    const believedLine = Math.round(strip + (height - strip) * (narrow ? 0.5 : 0.45)), ghostWheels = Math.round(height - 0.22 * (height - strip));

    const font = (size, bold) => `${bold ? "600 " : ""}${size}px system-ui, -apple-system, "Segoe UI", Roboto, Arial, sans-serif`;
    const line = (x0, y0, x1, y1, ink, thick = 2, dash = []) => {
      pen.strokeStyle = ink;
      pen.lineWidth = thick;
      pen.setLineDash(dash);
      pen.beginPath();
      pen.moveTo(x0, y0);
      pen.lineTo(x1, y1);
      pen.stroke();
      pen.setLineDash([]);
    };
    const shape = (points, fill, edge, dash = []) => {
      pen.beginPath();
      points.forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)));
      pen.closePath();
      if (fill) {
        pen.fillStyle = fill;
        pen.fill();
      }
      if (edge) {
        pen.strokeStyle = edge;
        pen.lineWidth = dash.length ? 2 : 1;
        pen.setLineDash(dash);
        pen.stroke();
        pen.setLineDash([]);
      }
    };
    const fitted = (words, size, bold, room) => {
      // letters shrunk to the room
      pen.font = font(size, bold);
      while (size > 9 && pen.measureText(words).width > room[1] - room[0]) pen.font = font((size -= 1), bold);
      return pen.measureText(words).width;
    };
    const text = (x, y, words, { ink = INK, size = small, anchor = "l", bold = false, room = [-FAR, FAR], ground = "" } = {}) => {
      const length = fitted(words, size, bold, room);
      x = Math.max(room[0], Math.min(x - { l: 0, m: 0.5, r: 1 }[anchor] * length, room[1] - length));
      if (ground) {
        pen.fillStyle = ground;
        pen.fillRect(x - 3, y - size, x ? length + 6 : length + 3, size * 1.25);
      }
      pen.fillStyle = ink;
      pen.fillText(words, x, y);
    };
    const head = (x, y, way, ink, size = 7) => shape([[x, y], [x - way * size, y - size * 0.6], [x - way * size, y + size * 0.6]], ink);
    const span = (x0, x1, y, ink, dash = []) => {
      // a dimension line between two bumpers, an arrow where it leaves the picture; returns the middle of what is seen
      const ends = [Math.min(x0, x1), Math.max(x0, x1)];
      const seen = ends.map((x) => clamp(x, margin / 2, width - margin / 2));
      line(seen[0], y, seen[1], y, ink, 2, dash);
      ends.forEach((end, i) => {
        if (ends[1] - ends[0] > 24 || end !== seen[i]) head(seen[i], y, i ? 1 : -1, ink);
        if (end === seen[i]) line(end, y - 7, end, y + 7, ink);
      });
      return (seen[0] + seen[1]) / 2;
    };
    const drawCar = (x, y, ink, ghost) => {
      const at = (part) => part.map(([a, b]) => [x - car + a * car, y - b * tall]);
      shape(at(BODY), ghost ? "" : ink, ghost ? ink : "", ghost ? [4, 4] : []);
      if (!ghost) shape(at(WINDOW), GLASS);
      for (const axle of AXLES) {
        pen.beginPath();
        pen.arc(x - car + axle * car, y - wheel, wheel, 0, 7);
        pen.fillStyle = ghost ? WHITE : INK;
        pen.fill();
        pen.strokeStyle = ink;
        pen.lineWidth = 2;
        pen.stroke();
      }
    };
    const vehicle = (x, ink, name, speed, room) => {
      // a car with its name and speed, or an arrow at the edge that it is beyond
      const way = x > width - margin + 1 ? 1 : x < margin + car - 1 ? -1 : 0;
      const middle = way ? (way > 0 ? width - margin : margin) : x - car / 2;
      if (way) head(middle, wheels - tall / 2, way, ink, car * 0.19);
      else drawCar(x, wheels, ink);
      text(middle, wheels + roadHeight + small + 2, name + (way ? (narrow ? ", far" : " (out of view)") : ""), { ink, anchor: "m", room });
      text(middle, wheels + roadHeight + 2 * small + 5, `${speed.toFixed(1)} m/s`, { ink, anchor: "m", bold: true, room });
    };
    const crash = (x, words, from, to) => {
      const y = wheels - tall / 2;
      shape([...Array(18).keys()].map((i) => [x + (i % 2 ? 0.12 : 0.29) * car * Math.cos((Math.PI * i) / 9), y + (i % 2 ? 0.12 : 0.29) * car * Math.sin((Math.PI * i) / 9)]), WARNING, INK);
      const length = fitted(words, large, true, [0, FAR]) + 2 * margin, left = clamp(x - length / 2, from, Math.max(from, to - length));
      pen.fillStyle = WARNING;
      pen.fillRect(left, trueLine - large - 8, length, large * 1.5);
      pen.strokeStyle = INK;
      pen.lineWidth = 2;
      pen.strokeRect(left, trueLine - large - 8, length, large * 1.5);
      text(left + margin, trueLine - large * 0.02 - 6, words, { size: large, bold: true });
    };

    const { road, rear, believed } = episode;
    const gap = road.gap[s], rearGap = rear ? rear.rear_gap[s] : Infinity;
    const first = SPANS.findIndex((metre) => gap <= metre), from = first < 0 ? SPANS.length - 1 : first;
    const scales = SPANS.slice(from, from + 2).map((metre) => ahead / metre);
    const scale = scales.find((each) => rearGap * each <= behind) ?? scales[0];
    const leader = nose + gap * scale, lane = ahead / 6;

    // the belief
    const belief = s ? believed.gap[s - 1] : null;
    pen.fillStyle = BELIEF_PALE;
    pen.fillRect(0, strip, width, height - strip);
    line(0, strip, width, strip, BELIEF, 1);
    line(0, ghostWheels, width, ghostWheels, BELIEF, 1, [3, 3]);
    text(margin, strip + small + 4, "WHERE THE EGO BELIEVES IT IS", { ink: BELIEF, room: [margin, width - margin] });
    if (belief !== null) {
      const ghost = clamp(nose + (gap - belief) * scale, -FAR, FAR);
      line(leader, trueLine, leader, ghostWheels, LEADER, 1, [3, 3]); // the same bumper in both strips
      const middle = span(ghost, leader, believedLine, BELIEF, [5, 5]);
      text(middle, believedLine - 9, `believed gap ${metres(belief)}`, { ink: BELIEF, size: large, anchor: "m", bold: true, room: [margin, width - margin], ground: BELIEF_PALE });
      if (ghost > 0 && ghost - car < width) drawCar(ghost, ghostWheels, BELIEF, true);
      else {
        const way = ghost > 0 ? 1 : -1, x = way > 0 ? width - margin : margin, y = ghostWheels - tall / 2;
        head(x, y, way, BELIEF, 18);
        text(x - way * 24, y + 5, `out of view: ${metres(Math.abs(gap - belief))} ${way > 0 ? "ahead of" : "behind"} where it really is`,
          { ink: BELIEF, anchor: way > 0 ? "r" : "l", room: [margin + 24, width - margin - 24], ground: BELIEF_PALE });
      }
    } else text(width / 2, believedLine, "no measurement yet", { ink: BELIEF, anchor: "m" });
    span(margin, margin + lane, height - 8, GREY);
    text(margin + lane + 8, height - 4, `${+(lane / scale).toFixed(2)} m`, { ink: GREY });

    // the truth
    text(margin, small + 4, "THE ROAD AS IT IS", { ink: GREY });
    pen.fillStyle = LEADER;
    pen.fillRect(0, wheels, width, roadHeight);
    pen.fillStyle = WHITE;
    const shift = ((-(road.position[s] * scale) % lane) + lane) % lane;
    for (let x = shift - lane; x < width; x += lane) pen.fillRect(x, wheels + roadHeight / 2 - 1, lane / 2, 2);
    const behindHit = rear && rearGap <= 0, frontHit = gap <= 0 || (s > 0 && s === episode.hit);
    if (rear) vehicle(tail - rearGap * scale, HUMAN, "human driver", rear.rear_speed[s], [margin, tail - 4]);
    vehicle(leader + car, LEADER, "leader", road.lead_speed[s], [nose + 2, width - margin]);
    vehicle(nose, EGO, narrow ? "ego" : "ego (ACC)", road.speed[s], [tail, nose]);
    const edge = tail + car / 4; // keeps the texts apart where both gaps are small
    if (behindHit) crash(tail, "REAR COLLISION", 2, nose - margin);
    else if (rear) {
      const middle = span(tail, tail - rearGap * scale, trueLine, HUMAN);
      text(middle, trueLine - 9, `${narrow ? "behind" : "gap behind"} ${metres(rearGap)}`, { ink: HUMAN, anchor: "m", room: [margin, edge] });
    }
    if (frontHit) crash(nose, "COLLISION", behindHit ? nose + 2 : 2, width - 2);
    else {
      const middle = span(nose, leader, trueLine, INK);
      text(middle, trueLine - 9, `true gap ${metres(gap)}`, { size: large, anchor: "m", bold: true, room: [behindHit ? nose + 4 : edge + margin, width - margin] });
    }
  };
})();
