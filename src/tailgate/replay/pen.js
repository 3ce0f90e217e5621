"use strict";
// Shared by the pictures: colours, letters, lines, cars. makePen returns the tools for one canvas, or null while it has no size.
const PEN = {
  INK: "#1a1a1a", GREY: "#5f5f5f", WHITE: "#fff", GLASS: "#dcebf5", LEADER: "#4d4d4d", EGO: "#0072b2", HUMAN: "#00805c", BELIEF: "#7a2a6b",
  BELIEF_PALE: "#f8eef5", WARNING: "#f0e442", ATTACK: "#b34700", FAR: 1e6,
};
const makePen = (() => {
  const { INK, WHITE, GLASS, WARNING, ATTACK, FAR } = PEN;
  const BODY = [[0, 0.18], [0, 0.6], [0.12, 0.64], [0.26, 1], [0.62, 1], [0.78, 0.62], [0.97, 0.54], [1, 0.18]];
  const WINDOW = [[0.2, 0.66], [0.3, 0.92], [0.59, 0.92], [0.7, 0.66]];
  const AXLES = [0.22, 0.78], BOLT = [[0, 0], [0.75, -1.1], [0.2, -1], [0.6, -2], [-0.6, -0.85], [-0.05, -0.95]];
  const metres = (x) => {
    const digits = x && Math.abs(x) < 0.95 ? 2 : 1; // a small gap must not read as 0.0
    return `${x.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits }).replace("-", "−")} m`;
  };
  const clamp = (x, low, high) => Math.max(low, Math.min(x, high));

  return (canvas) => {
    const width = canvas.clientWidth, height = canvas.clientHeight, ratio = window.devicePixelRatio || 1;
    if (!width) return null;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);

    const narrow = width < 600, margin = narrow ? 5 : 12, small = narrow ? 11 : 13, large = narrow ? 15 : 20;

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
      // letters shrink to the room
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
      // a dimension line between two bumpers, an arrow where it leaves the picture; returns the middle of its visible part
      const ends = [Math.min(x0, x1), Math.max(x0, x1)];
      const seen = ends.map((x) => clamp(x, margin / 2, width - margin / 2));
      line(seen[0], y, seen[1], y, ink, 2, dash);
      ends.forEach((end, i) => {
        if (ends[1] - ends[0] > 24 || end !== seen[i]) head(seen[i], y, i ? 1 : -1, ink);
        if (end === seen[i]) line(end, y - 7, end, y + 7, ink);
      });
      return (seen[0] + seen[1]) / 2;
    };
    const drawCar = (x, y, ink, ghost, car) => {
      const tall = car * 0.405, wheel = car * 0.09, at = (part) => part.map(([a, b]) => [x - car + a * car, y - b * tall]);
      shape(at(BODY), ghost ? "" : ink, ghost ? ink : "", ghost ? [4, 4] : []);
      if (!ghost) shape(at(WINDOW), GLASS);
      for (const axle of AXLES) disc(x - car + axle * car, y - wheel, wheel, ghost ? WHITE : INK, ink);
    };
    const disc = (x, y, radius, fill, edge, thick = 2) => {
      pen.beginPath();
      pen.arc(x, y, radius, 0, 7);
      pen.fillStyle = fill;
      pen.fill();
      pen.strokeStyle = edge;
      pen.lineWidth = thick;
      pen.stroke();
    };
    // a star where two cars touch, and large words on yellow between `from` and `to`
    const burst = (x, y, size) => shape([...Array(18).keys()].map((i) => [x + (i % 2 ? 0.414 : 1) * size * Math.cos((Math.PI * i) / 9), y + (i % 2 ? 0.414 : 1) * size * Math.sin((Math.PI * i) / 9)]), WARNING, INK);
    const sign = (x, y, words, from, to) => {
      const length = fitted(words, large, true, [0, FAR]) + 2 * margin, left = clamp(x - length / 2, from, Math.max(from, to - length));
      pen.fillStyle = WARNING;
      pen.fillRect(left, y - large - 8, length, large * 1.5);
      pen.strokeStyle = INK;
      pen.lineWidth = 2;
      pen.strokeRect(left, y - large - 8, length, large * 1.5);
      text(left + margin, y - large * 0.02 - 6, words, { size: large, bold: true });
    };
    // marks of an agent: a lightning with its tip at (x, y), a lamp with an exclamation mark
    const bolt = (x, y, size) => shape(BOLT.map(([a, b]) => [x + a * size, y + b * size]), ATTACK, INK);
    const lamp = (x, y, size) => {
      disc(x, y, size, INK, INK);
      text(x, y + size * 0.5, "!", { ink: WARNING, size: Math.round(size * 1.5), anchor: "m", bold: true });
    };
    return { pen, width, height, narrow, margin, small, large, metres, clamp, font, line, shape, fitted, text, head, span, drawCar, disc, burst, sign, bolt, lamp };
  };
})();
