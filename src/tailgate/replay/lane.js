// The lane from above at one step, drawn as tailgate.envs.render.lane draws it: across and along are to scale, each to its own.
const drawLane = (() => {
  const { INK, GREY, WHITE, LEADER, EGO, BELIEF } = PEN, LENGTH = 4.5, WIDE = 1.8, DASH = 6;

  return (canvas, episode, s) => {
    const tools = makePen(canvas);
    if (!tools) return;
    const { width, height, narrow, margin, small, clamp, line, shape, text, sign } = tools;
    const { half, offset, heading, curvature, believed, turned } = episode.lane;
    const across = height / 7, along = across * 0.6, here = width * 0.27, middle = height * 0.5, bend = curvature[s];
    const at = (x, y) => [here + x * along, middle - (y + 0.5 * bend * x * x) * across];
    const signed = (x) => `${x < 0 ? "−" : "+"}${Math.abs(x).toFixed(2)} m`;

    // the road, which bends by its curvature now
    const xs = [];
    for (let x = -here / along; x < (width - here) / along + 1; x += 1) xs.push(x);
    shape([...xs.map((x) => at(x, half)), ...xs.map((x) => at(x, -half)).reverse()], "#ececec", "");
    for (const side of [half, -half]) for (let i = 1; i < xs.length; i += 1) line(...at(xs[i - 1], side), ...at(xs[i], side), LEADER, 4);
    for (let x = -(episode.road.position[s] % (2 * DASH)) - 2 * DASH; x < xs[xs.length - 1]; x += 2 * DASH) line(...at(x, 0), ...at(x + DASH, 0), WHITE, 2);

    const body = (y, turn) => [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]].map(([a, b]) => [
      here + a * LENGTH * along, middle - (clamp(y, -50, 50) + b * WIDE + a * LENGTH * Math.sin(clamp(turn, -1, 1))) * across]);
    shape(body(offset[s], heading[s]), EGO, INK);
    const room = [margin, width - margin];
    if (s) {
      shape(body(offset[s] + believed[s - 1], heading[s] + turned[s - 1]), "", BELIEF, [4, 4]);
      text(width - margin, height - small - 14, `believed ${signed(offset[s] + believed[s - 1])}`, { ink: BELIEF, anchor: "r", bold: true, room, ground: WHITE });
    } else text(width - margin, height - small - 14, "nothing is measured before step 1", { ink: BELIEF, anchor: "r", room, ground: WHITE });
    text(width - margin, height - 8, `offset ${signed(offset[s])} of ${half} m`, { ink: EGO, anchor: "r", bold: true, room, ground: WHITE });
    const radius = Math.abs(bend) < 1e-6 ? "straight" : `${narrow ? "" : "bend of "}${Math.round(1 / Math.abs(bend))} m to the ${bend > 0 ? "left" : "right"}`;
    text(margin, height - 8, `${episode.road.speed[s].toFixed(1)} m/s, ${radius}`, { ink: GREY, room: [margin, width * 0.6], ground: WHITE });
    if (s && s === episode.hit) sign(width / 2, 34, "OFF THE LANE", 2, width - 2);
  };
})();
