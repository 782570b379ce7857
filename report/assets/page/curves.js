// What the lambda read, a plot for each field, grouped by input.

const CURVE_PX = 76;
/** What the numbers of the axis of time take: the last plot of a group has them. */
const AXIS_PX = 22;
/** Time between neighbours, over what is usual, from which on nothing is drawn between them: nobody looked there. */
const GAP = 8;

/** The curves of all runs; those of one field are together: `{ input, topic, path, of: [{ run, index, curve }] }`. */
function fieldsOf(page) {
  const fields = new Map();
  page.runs.forEach((run, index) => run.curves.forEach((curve) => {
    const key = JSON.stringify([curve.input, curve.topic, curve.path]);
    if (!fields.has(key)) fields.set(key, { input: curve.input, topic: curve.topic, path: curve.path, of: [] });
    fields.get(key).of.push({ run, index, curve });
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
  const caption = make("div", { class: "caption" }, make("b", { text: field.path }), ...field.of.map(({ index, curve }) => notes(curve, several ? index : null)), value);
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

/** How often the field was read, and what of it is in no point. */
function notes(curve, index) {
  const words = [`${counted(curve.samples, "sample")}`];
  if (curve.per_point > 1) words.push(`least and most of ${curve.per_point} each`);
  if (curve.non_finite > 0) words.push(`${count(curve.non_finite)} not finite`);
  const name = index === null ? "" : `${"AB"[index]}: `;
  return make("span", { class: "dim" }, index === null ? null : swatch(paletteStyle(index)), name + words.join(", "));
}

/** The points of one curve, with a hole where nobody looked for long. */
function withGaps({ t, min, max }) {
  const steps = t.slice(1).map((time, at) => time - t[at]).filter((step) => step > 0).sort((a, b) => a - b);
  const usual = steps[Math.floor(steps.length / 2)] ?? Infinity;
  const points = { t: [], min: [], max: [] };
  t.forEach((time, at) => {
    if (at > 0 && time - t[at - 1] > GAP * usual) {
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

/** A field as uPlot takes it: one line, or two with what is between them filled, for each run. */
function drawn(field, page) {
  const [series, bands, tables] = [[{}], [], []];
  field.of.forEach(({ index, curve }) => {
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
  // Two runs need not have read at the same times; a hole is kept, a time that only the other one has is passed over.
  const data = tables.length === 1 ? tables[0] : uPlot.join(tables, tables.map((one) => one.map(() => 2)));
  if (tables.length > 1) series.slice(1).forEach((one) => { one.spanGaps = false; });
  return { data, series, bands };
}

/** What the field was at the pointer. */
function valueAt(plot, field, several) {
  const { left } = plot.cursor;
  if (left === undefined || left < 0) return "";
  const t = plot.posToVal(left, "x");
  const words = field.of.map(({ index, curve }) => {
    const at = nearest(curve.t, t);
    if (at < 0) return "";
    const [least, most] = [curve.min[at], curve.max[at] ?? curve.min[at]];
    const value = least === most ? number(least) : `${number(least)} to ${number(most)}`;
    return several ? `${"AB"[index]} ${value}` : value;
  });
  return words.filter(Boolean).join("   ");
}

/** The place in `times` that is nearest to `t`; -1 if there is none. */
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

/** A line at each trigger, and one at what is chosen. */
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
