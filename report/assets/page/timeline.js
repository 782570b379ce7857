// The state that all plots share: visible range, pointer and chosen entry.

const LEFT = 92;
const RIGHT = 12;
const SHORTEST_S = 0.002;
const NEAR_S = 10;

const timeline = {
  /** Whole range, in s. */
  all: [0, 1],
  view: [0, 1],
  plots: [],
  /** Entries for the arrow keys, by time: `{ t, run, kind, ... }`. */
  entries: [],
  /** Their kind: `trigger`, `fault` or `difference`. */
  kind: "trigger",
  chosen: null,
  choiceListeners: [],
  hoverListeners: [],
};

/** Shows `from` to `to`, within the whole range. */
function zoom(from, to) {
  const [first, last] = timeline.all;
  const span = Math.min(Math.max(to - from, SHORTEST_S), last - first);
  const begin = Math.min(Math.max(from, first), last - span);
  timeline.view = [begin, begin + span];
  timeline.plots.forEach((plot) => plot.setScale("x", { min: begin, max: begin + span }));
}

function zoomOut() {
  zoom(...timeline.all);
}

/** Centres `t`, and zooms in to at most 2 * `NEAR_S`. */
function goTo(t) {
  const span = Math.min(timeline.view[1] - timeline.view[0], 2 * NEAR_S);
  zoom(t - span / 2, t + span / 2);
}

/** Chooses an entry, centres it and notifies the listeners. `null` clears the choice. */
function choose(entry) {
  if (entry) goTo((entry.t + (entry.to ?? entry.t)) / 2);
  point(entry);
}

/** Chooses an entry without moving. */
function point(entry) {
  timeline.chosen = entry;
  timeline.plots.forEach((plot) => plot.redraw(false));
  timeline.choiceListeners.forEach((listener) => listener(entry));
}

/** Chooses the next or previous entry, from the chosen one, else from the edge of the view. */
function step(by) {
  const marks = timeline.entries;
  if (marks.length === 0) return;
  const at = timeline.chosen ? marks.indexOf(timeline.chosen) : -1;
  if (at >= 0) return choose(marks[Math.min(Math.max(at + by, 0), marks.length - 1)]);
  const from = timeline.chosen?.t ?? (by > 0 ? timeline.view[0] : timeline.view[1]);
  const next = by > 0 ? marks.find((mark) => mark.t >= from) : marks.findLast((mark) => mark.t <= from);
  choose(next ?? (by > 0 ? marks[marks.length - 1] : marks[0]));
}

/** Common options of all plots over time. */
function timePlot({ height, series, scales, axes, hooks = {}, bands }) {
  const font = "11px system-ui, sans-serif";
  const grid = { stroke: () => colour("faint"), width: 1 };
  const axis = { font, stroke: () => colour("dim"), grid, ticks: { show: false } };
  const select = (plot) => {
    const { left, width } = plot.select;
    if (width < 4) return;
    const [from, to] = [plot.posToVal(left, "x"), plot.posToVal(left + width, "x")];
    plot.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
    zoom(from, to);
  };
  const move = (plot) => {
    const { left } = plot.cursor;
    const t = left >= 0 ? plot.posToVal(left, "x") : null;
    timeline.hoverListeners.forEach((listener) => listener(t));
  };
  return {
    width: 600, height, series, bands,
    padding: [4, RIGHT, 0, 0],
    legend: { show: false },
    scales: { x: { time: false, range: () => timeline.view }, ...scales },
    axes: [
      { ...axis, size: 26, gap: 6, values: (_, splits) => splits.map((t) => `${Number(t.toFixed(6))} s`), ...axes?.x },
      { ...axis, size: LEFT, gap: 6, ...axes?.y },
    ],
    cursor: {
      y: false,
      drag: { x: true, y: false, setScale: false },
      sync: { key: "time", setSeries: false, scales: ["x", null], filters: { pub: (event) => event === "mousemove" || event === "mouseleave" } },
      bind: { dblclick: () => () => { zoomOut(); return null; } },
    },
    hooks: { ...hooks, setSelect: [select], setCursor: [move, ...(hooks.setCursor ?? [])] },
  };
}

/** Adds a plot to `place` and keeps its width. */
function addPlot(options, data, place) {
  const plot = new uPlot({ ...options, width: Math.max(place.clientWidth, 300) }, data, place);
  timeline.plots.push(plot);
  const wheel = (event) => {
    if (!event.ctrlKey && !event.metaKey && !event.shiftKey) return;
    event.preventDefault();
    const [from, to] = timeline.view;
    const turn = event.deltaY || event.deltaX;
    if (event.shiftKey) return zoom(from + (to - from) * Math.sign(turn) * 0.1, to + (to - from) * Math.sign(turn) * 0.1);
    const t = plot.posToVal(event.offsetX, "x");
    const by = turn > 0 ? 1.25 : 0.8;
    zoom(t - (t - from) * by, t + (to - t) * by);
  };
  plot.over.addEventListener("wheel", wheel, { passive: false });
  keepWidth(plot, place);
  return plot;
}
