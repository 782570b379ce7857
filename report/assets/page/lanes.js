// The lanes above the curves: triggers by label, faults, clips and differences.

const LANE_PX = 24;
/** Maximum number of lanes for labels; the rarest labels share one. */
const LANES_MAX = 8;
const HIT_PX = 7;

/** The lanes of all runs, top to bottom: `{ name, items, dense }`, where items are entries of the timeline. */
function lanesOf(page, entries) {
  const lanes = [];
  const several = page.runs.length > 1;
  page.runs.forEach((run, index) => {
    const before = several ? `${"AB"[index]} ` : "";
    const of = (kind) => entries.filter((entry) => entry.run === run && entry.kind === kind);
    const triggers = of("trigger");
    if (several) lanes.push({ name: `${before}triggers`, items: triggers, dense: run.trigger_density, colours: index });
    else lanes.push(...labelLanes(run, triggers));
    if (run.totals.faults > 0) lanes.push({ name: `${before}faults`, items: of("fault"), dense: run.fault_density, colours: null });
    if (run.totals.clips > 0) lanes.push({ name: `${before}clips`, items: of("clip"), dense: [] });
  });
  if (page.diff) lanes.push({ name: "differences", items: entries.filter((entry) => entry.kind === "difference"), dense: [] });
  return lanes;
}

function labelLanes(run, triggers) {
  const totals = run.labels.map((label, number) => ({ label, number, total: 0 }));
  triggers.forEach((entry) => { totals[entry.label].total += 1; });
  const shared = totals.length > LANES_MAX;
  const own = shared ? [...totals].sort((a, b) => b.total - a.total).slice(0, LANES_MAX - 1) : totals;
  const lane = (name, numbers) => ({
    name,
    items: triggers.filter((entry) => numbers.has(entry.label)),
    dense: run.trigger_density.filter((bin) => numbers.has(bin.lane)),
  });
  const lanes = own.map(({ label, number }) => lane(label, new Set([number])));
  const rest = totals.filter((one) => !own.includes(one)).map((one) => one.number);
  return shared ? [...lanes, lane("other labels", new Set(rest))] : lanes;
}

/** The colour of an entry. */
function entryColour(entry) {
  if (entry.kind === "fault") return colour("bad");
  if (entry.kind === "difference") return colour({ removed: "bad", added: "good", changed: "warn" }[entry.change]);
  return paletteColour(entry.colour);
}

/** Draws the lanes into `place`. */
function drawLanes(lanes, place) {
  if (lanes.length === 0) return;
  const height = lanes.length * LANE_PX;
  const centre = (lane) => lanes.length - lane - 0.5;
  const options = timePlot({
    height: height + 32,
    series: [{}, { show: true, points: { show: false } }],
    scales: { y: { range: () => [0, lanes.length] } },
    axes: {
      y: {
        splits: () => lanes.map((_, lane) => centre(lane)),
        values: () => lanes.map((lane) => clipped(lane.name)),
        grid: { show: false },
      },
    },
    hooks: { drawClear: [(plot) => drawGround(plot, lanes)], draw: [(plot) => lanes.forEach((lane, at) => drawLane(plot, lane, at, lanes.length))] },
  });
  const plot = addPlot(options, [timeline.all, [null, null]], place);
  let pressed = 0;
  plot.over.addEventListener("mousedown", (event) => { pressed = event.clientX; });
  plot.over.addEventListener("click", (event) => {
    const hit = entryAt(plot, lanes, event.offsetX, event.offsetY);
    if (hit && Math.abs(event.clientX - pressed) < 4) choose(hit);
  });
  plot.over.addEventListener("mousemove", (event) => {
    const hit = entryAt(plot, lanes, event.offsetX, event.offsetY);
    plot.over.style.cursor = hit ? "pointer" : "";
    plot.over.title = hit ? entryTitle(hit) : "";
  });
}

function clipped(name) {
  return name.length > 13 ? `${name.slice(0, 12)}…` : name;
}

/** One line about an entry. */
function entryTitle(entry) {
  const time = entry.kind === "clip" ? `${seconds(entry.t)} to ${seconds(entry.to)}` : seconds(entry.t);
  const score = entry.score === null || entry.score === undefined ? "" : `, ${number(entry.score)}`;
  return `${entry.title}${score}, ${time}`;
}

/** Shades every other lane. */
function drawGround(plot, lanes) {
  const { ctx, bbox } = plot;
  const step = bbox.height / lanes.length;
  ctx.fillStyle = colour("faint");
  lanes.forEach((_, at) => { if (at % 2 === 0) ctx.fillRect(bbox.left, bbox.top + at * step, bbox.width, step); });
}

function drawLane(plot, lane, at, count) {
  const { ctx, bbox } = plot;
  const step = bbox.height / count;
  const middle = bbox.top + (at + 0.5) * step;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  drawDense(plot, lane, middle, step);
  const drawn = new Set();
  for (const entry of lane.items) {
    if ((entry.to ?? entry.t) < timeline.view[0] || entry.t > timeline.view[1] || entry === timeline.chosen) continue;
    const x = Math.round(plot.valToPos(entry.t, "x", true));
    const key = `${x} ${entry.colour} ${entry.change}`;
    // Thousands may share one pixel.
    if (!entry.to && drawn.has(key)) continue;
    drawn.add(key);
    drawEntry(plot, entry, x, middle, step);
  }
  if (lane.items.includes(timeline.chosen)) drawEntry(plot, timeline.chosen, Math.round(plot.valToPos(timeline.chosen.t, "x", true)), middle, step);
  ctx.restore();
}

/** Draws density bars for incomplete lists, darker where there are more entries. */
function drawDense(plot, lane, middle, step) {
  const most = Math.max(1, ...lane.dense.map((bin) => bin.count));
  for (const bin of lane.dense) {
    if (bin.to < timeline.view[0] || bin.from > timeline.view[1]) continue;
    const [from, to] = [bin.from, bin.to].map((t) => plot.valToPos(t, "x", true));
    const tone = lane.colours === null ? colour("bad") : paletteColour(lane.colours ?? bin.lane);
    plot.ctx.fillStyle = faded(tone, 0.18 + 0.4 * Math.log1p(bin.count) / Math.log1p(most));
    plot.ctx.fillRect(from, middle - step * 0.26, Math.max(to - from, 1), step * 0.52);
  }
}

function drawEntry(plot, entry, x, middle, step) {
  const { ctx } = plot;
  const isChosen = entry === timeline.chosen;
  const tall = step * (isChosen ? 0.42 : 0.31);
  const unit = devicePixelRatio;
  ctx.fillStyle = ctx.strokeStyle = isChosen ? colour("ink") : entryColour(entry);
  if (entry.kind === "clip") {
    const width = Math.max(plot.valToPos(entry.to, "x", true) - x, 2 * unit);
    ctx.globalAlpha = isChosen ? 0.6 : 0.45;
    ctx.fillRect(x, middle - tall, width, 2 * tall);
    ctx.globalAlpha = 1;
    ctx.fillRect(x, middle - tall, Math.max(1, unit), 2 * tall);
    return;
  }
  if (entry.kind === "fault") {
    ctx.lineWidth = 1.6 * unit;
    const arm = tall * 0.7;
    ctx.beginPath();
    for (const way of [1, -1]) { ctx.moveTo(x - arm, middle - way * arm); ctx.lineTo(x + arm, middle + way * arm); }
    ctx.stroke();
    return;
  }
  if (entry.kind === "difference") return drawDifference(ctx, entry.change, x, middle, tall);
  ctx.fillRect(x - 1.5 * unit, middle - tall, 3 * unit, 2 * tall);
  // The start or stop of a recording points into it.
  const way = { start: 1, stop: -1 }[entry.mark?.kind];
  if (!way) return;
  ctx.beginPath();
  ctx.moveTo(x, middle - tall);
  ctx.lineTo(x + way * 7 * unit, middle);
  ctx.lineTo(x, middle + tall);
  ctx.fill();
}

/** Distinguished by more than colour: a ring is removed, a disc is added, a diamond is changed. */
function drawDifference(ctx, change, x, middle, size) {
  ctx.lineWidth = 1.6 * devicePixelRatio;
  ctx.beginPath();
  if (change === "changed") [[0, -1], [1, 0], [0, 1], [-1, 0]].forEach(([right, down]) => ctx.lineTo(x + right * size, middle + down * size));
  else ctx.arc(x, middle, size * 0.75, 0, 2 * Math.PI);
  ctx.closePath();
  if (change === "removed") ctx.stroke();
  else ctx.fill();
}

/** The entry nearest to (x, y), in CSS pixels of the plot; null if none is near. */
function entryAt(plot, lanes, x, y) {
  const lane = lanes[Math.floor(y / (plot.over.clientHeight / lanes.length))];
  let [nearest, least] = [null, HIT_PX];
  for (const entry of lane?.items ?? []) {
    const [from, to] = [entry.t, entry.to ?? entry.t].map((t) => plot.valToPos(t, "x"));
    const distance = x < from ? from - x : x > to ? x - to : 0;
    if (distance < least) [nearest, least] = [entry, distance];
  }
  return nearest;
}
