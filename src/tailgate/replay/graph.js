// A network at one step, drawn as tailgate.envs.render_network draws it: agents shaded by their errors, and the errors as bars.
const drawGraph = (() => {
  const { INK, GREY, WHITE, ATTACK } = PEN;
  const LOW = -3, HIGH = 4, PALE = [0xee, 0xf4, 0xfa], DEEP = [0x08, 0x30, 0x6b], MOST = 20; // decades of the shade; bars at most
  const share = (error) => (error ? Math.max(0, Math.min((Math.log10(error) - LOW) / (HIGH - LOW), 1)) : 0);
  const shade = (error) => `rgb(${PALE.map((a, i) => Math.round(a + (DEEP[i] - a) * share(error))).join()})`;
  const short = (error) => (error >= 1000 && error < 1e6 ? error.toFixed(0) : String(+error.toPrecision(3)));

  return (canvas, episode, s, agent) => {
    const tools = makePen(canvas);
    if (!tools) return;
    const { pen, width, height, narrow, margin, small, clamp, line, shape, text, disc, bolt, lamp } = tools;
    const { places, edges, error } = episode.graph, count = places.length;
    const size = error.map((values) => (s ? values[s - 1] : null));
    const attacked = s ? episode.attacked[s - 1] : size.map(() => 0), alarmed = s ? episode.alarms[s - 1] : size.map(() => 0);
    const split = narrow ? width : Math.round(width * 0.58), radius = clamp(21 * Math.sqrt(12 / count), 6, narrow ? 14 : 19), inset = radius + 20;
    const at = places.map(([x, y]) => [inset + x * (split - 2 * inset), inset + (1 - y) * (height - 2 * inset)]);
    for (const [a, b, mutual] of edges) {
      const [x0, y0] = at[a], [x1, y1] = at[b], far = Math.max(1, Math.hypot(x1 - x0, y1 - y0)), ux = (x1 - x0) / far, uy = (y1 - y0) / far;
      line(x0, y0, x1, y1, GREY, 1.2);
      if (!mutual) {
        const tip = [x1 - ux * radius, y1 - uy * radius]; // an arrowhead at the receiver
        shape([tip, ...[1, -1].map((way) => [tip[0] - 9 * ux + way * 4 * uy, tip[1] - 9 * uy - way * 4 * ux])], GREY);
      }
    }
    at.forEach(([x, y], i) => {
      if (attacked[i]) disc(x, y, radius + 4, WHITE, ATTACK);
      disc(x, y, radius, shade(size[i]), attacked[i] ? ATTACK : INK, i === agent ? 4 : 2); // a thick rim: the agent of the plots
      if (radius >= 8) text(x, y + small * 0.36, String(i), { ink: share(size[i]) > 0.45 ? WHITE : INK, size: radius > 14 ? small + 1 : 10, anchor: "m", bold: true });
      if (attacked[i]) bolt(x - radius * 0.85, y - radius * 0.75, 8);
      if (alarmed[i]) lamp(x + radius * 0.85, y - radius * 0.85, 8);
    });
    if (narrow) return; // the plots below show the errors
    const left = split + 42, right = width - 70, top = 34, low = height - 22;
    line(split, 0, split, height, GREY, 1);
    const order = [...size.keys()].sort((a, b) => size[b] - size[a] || a - b).slice(0, MOST), some = count > MOST ? order : order.sort((a, b) => a - b);
    text(split + margin, small + 5, count > MOST ? `THE ${MOST} LARGEST ERRORS, 2-NORM` : "ERROR OF EACH AGENT'S ESTIMATE, 2-NORM", { ink: GREY, room: [split + margin, width - margin] });
    for (let decade = LOW; decade <= HIGH; decade += 1) {
      const x = left + (right - left) * share(10 ** decade);
      line(x, top - 6, x, low, "#d5d8dc", 1);
      text(x, low + 14, String(10 ** decade), { ink: GREY, size: 10, anchor: "m" });
    }
    if (!s) return text((left + right) / 2, (top + low) / 2, "no estimate yet", { ink: GREY, anchor: "m" });
    const pitch = (low - top) / some.length, letters = pitch > 15 ? small : pitch >= 9 ? 9 : 0;
    some.forEach((i, place) => {
      const y = top + pitch * place, long = Math.max(1, (right - left) * share(size[i])), middle = y + pitch / 2;
      pen.fillStyle = shade(Math.max(size[i], 0.05));
      pen.fillRect(left, y + pitch * 0.15, long, pitch * 0.7);
      pen.strokeStyle = attacked[i] ? ATTACK : INK;
      pen.lineWidth = 1;
      pen.strokeRect(left, y + pitch * 0.15, long, pitch * 0.7);
      if (!letters) return;
      text(left - 8, middle + letters * 0.36, String(i), { size: letters, anchor: "r", bold: Boolean(attacked[i]) });
      text(left + long + 6, middle + letters * 0.36, short(size[i]), { size: letters });
      if (attacked[i]) bolt(left - 32, middle + 6, 6);
      if (alarmed[i]) lamp(width - 12, middle, Math.min(7, pitch / 2));
    });
  };
})();
