// The fields that the lambda read: a plot for each, grouped by input.

const CURVE_PX = 76;
/** Height of the time axis, which only the last plot of a group has. */
const AXIS_PX = 22;
/** Gaps longer than this many median intervals are not drawn over: the lambda did not read the field there. */
const GAP = 8;

/** The curves of all runs by field: `{ input, topic, path, curves: [{ run, index, curve }] }`. */
function fieldsOf(page) {
  const fields = new Map();
  page.runs.forEach((run, index) => run.curves.forEach((curve) => {
    const key = JSON.stringify([curve.input, curve.topic, curve.path]);
    if (!fields.has(key)) fields.set(key, { input: curve.input, topic: curve.topic, path: curve.path, curves: [] });
    fields.get(key).curves.push({ run, index, curve });
  }));
  return [...fields.values()];
}

/** Draws all fields into `place`. */
function drawCurves(page, entries, place) {
  const groups = new Map();
  for (const field of fieldsOf(page)) {
    const key = JSON.stringify([field.input, field.topic]);
    groups.set(key, [...(groups.get(key) ?? []), field]);
  }
  for (const fields of groups.values()) {
    const title = make("span", { class: "dim" }, make("b", { text: fields[0].input }), ` ${fields[0].topic}`);
    const group = place.appendChild(make("div", { class: "group" }, title));
    fields.forEach((field) => drawField(page, entries, field, group, field === fields[fields.length - 1]));
  }
}

function drawField(page, entries, field, group, isLast) {
  const several = page.runs.length > 1;
  const value = make("span", { class: "value dim" });
  const caption = make("div", { class: "caption" }, make("b", { text: field.path }), ...field.curves.map(({ index, curve }) => notes(curve, several ? index : null)), value);
  const place = group.appendChild(make("div"));
  group.insertBefore(caption, place);

  const { data, series, bands } = drawn(field, page);
  const options = timePlot({
    height: CURVE_PX + (isLast ? AXIS_PX : 0), series, bands,
    axes: { y: { values: (_, splits) => splits.map(number), space: 20 }, x: isLast ? {} : { size: 4, values: () => [] } },
    hooks: {
      drawClear: [(plot) => drawClips(plot, entries)],
      draw: [(plot) => drawMarks(plot, entries)],
      setCursor: [(plot) => { value.textContent = valueAt(plot, field, several); }],
    },
  });
  addPlot(options, data, place);
}

/** Number of samples, samples per point and non-finite values. */
function notes(curve, index) {
  const words = [`${counted(curve.samples, "sample")}`];
  if (curve.per_point > 1) words.push(`min and max of ${curve.per_point} per point`);
  if (curve.non_finite > 0) words.push(`${count(curve.non_finite)} not finite`);
  const name = index === null ? "" : `${"AB"[index]}: `;
  return make("span", { class: "dim" }, index === null ? null : swatch(paletteStyle(index)), name + words.join(", "));
}

/** The points of one curve, with gaps where the field was not read. */
function withGaps({ t, min, max }) {
  const steps = t.slice(1).map((time, at) => time - t[at]).filter((step) => step > 0).sort((a, b) => a - b);
  const median = steps[Math.floor(steps.length / 2)] ?? Infinity;
  const points = { t: [], min: [], max: [] };
  t.forEach((time, at) => {
    if (at > 0 && time - t[at - 1] > GAP * median) {
      points.t.push((time + t[at - 1]) / 2);
      points.min.push(null);
      points.max.push(null);
    }
    points.t.push(time);
    points.min.push(min[at]);
    points.max.push(max.length > 0 ? max[at] : min[at]);
  });
  return points;
}

/** Data for uPlot: for each run one line, or a filled band between two lines. */
function drawn(field, page) {
  const [series, bands, tables] = [[{}], [], []];
  field.curves.forEach(({ index, curve }) => {
    const stroke = () => paletteColour(page.runs.length > 1 ? index : 0);
    const line = { stroke, width: 1.25, points: { size: 4, fill: stroke } };
    const points = withGaps(curve);
    const isBand = curve.max.length > 0;
    if (isBand) {
      bands.push({ series: [series.length, series.length + 1], fill: () => faded(stroke(), 0.3) });
      series.push({ ...line, points: { show: false } }, { ...line, points: { show: false } });
    } else {
      series.push(line);
    }
    tables.push(isBand ? [points.t, points.max, points.min] : [points.t, points.min]);
  });
  // Two runs may have read at different times: gaps are kept, times that only the other run has are skipped.
  const data = tables.length === 1 ? tables[0] : uPlot.join(tables, tables.map((one) => one.map(() => 2)));
  if (tables.length > 1) series.slice(1).forEach((one) => { one.spanGaps = false; });
  return { data, series, bands };
}

/** The value of the field at the pointer. */
function valueAt(plot, field, several) {
  const { left } = plot.cursor;
  if (left === undefined || left < 0) return "";
  const t = plot.posToVal(left, "x");
  const words = field.curves.map(({ index, curve }) => {
    const at = nearest(curve.t, t);
    if (at < 0) return "";
    const [least, most] = [curve.min[at], curve.max[at] ?? curve.min[at]];
    const value = least === most ? number(least) : `${number(least)} to ${number(most)}`;
    return several ? `${"AB"[index]} ${value}` : value;
  });
  return words.filter(Boolean).join("   ");
}

/** The index in `times` nearest to `t`; -1 if `times` is empty. */
function nearest(times, t) {
  let [low, high] = [0, times.length - 1];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] < t) low = middle + 1;
    else high = middle;
  }
  return low > 0 && t - times[low - 1] < times[low] - t ? low - 1 : low < times.length ? low : -1;
}

function drawClips(plot, entries) {
  const { ctx, bbox } = plot;
  ctx.fillStyle = `rgba(${colour("clip")}, .07)`;
  for (const entry of entries) {
    if (entry.kind !== "clip" || entry.to < timeline.view[0] || entry.t > timeline.view[1]) continue;
    const [from, to] = [entry.t, entry.to].map((t) => Math.min(Math.max(plot.valToPos(t, "x", true), bbox.left), bbox.left + bbox.width));
    ctx.fillRect(from, bbox.top, to - from, bbox.height);
  }
}

/** Draws a line at each trigger and one at the chosen entry. */
function drawMarks(plot, entries) {
  const { ctx, bbox } = plot;
  const drawn = new Set();
  const line = (t, width) => {
    if (t < timeline.view[0] || t > timeline.view[1]) return;
    const x = Math.round(plot.valToPos(t, "x", true));
    if (drawn.has(x) && width === 1) return;
    drawn.add(x);
    ctx.fillRect(x, bbox.top, width * devicePixelRatio, bbox.height);
  };
  ctx.save();
  for (const entry of entries) {
    if (entry.kind !== "trigger") continue;
    ctx.fillStyle = faded(entryColour(entry), 0.35);
    line(entry.t, 1);
  }
  if (timeline.chosen && timeline.chosen.kind !== "clip") {
    ctx.fillStyle = colour("ink");
    line(timeline.chosen.t, 1.5);
  }
  ctx.restore();
}
