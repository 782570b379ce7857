// Reads the data, draws the page, and listens to the keys.

/** All that can be chosen, by time. */
function entriesOf(page) {
  const several = page.runs.length > 1;
  const entries = page.runs.flatMap((run, index) => [
    ...run.triggers.map((mark) => ({ kind: "trigger", run, t: mark.t, label: mark.label, colour: several ? index : mark.label, score: mark.score, title: run.labels[mark.label], mark })),
    ...run.faults.map((mark) => ({ kind: "fault", run, t: mark.t, title: `fault: ${plain(run.fault_kinds[mark.lane])}`, mark })),
    ...run.clips.map((clip) => ({ kind: "clip", run, t: clip.from, to: Math.max(clip.to, clip.from + 1e-6), colour: index, title: "clip", clip })),
  ]);
  const differences = (page.diff?.differences ?? []).map((difference) => ({
    kind: "difference", run: page.runs[0], t: difference.t, is: difference.is, title: `${difference.label}, ${difference.is}`, difference,
  }));
  return [...entries, ...differences].sort((a, b) => a.t - b.t);
}

/** From the first thing to the last, of all runs. */
function spanOf(page, entries) {
  const times = page.runs.flatMap((run) => [run.from, run.to]).concat(entries.flatMap((entry) => (entry.kind === "clip" ? [] : [entry.t])));
  const [from, to] = times.reduce(([least, most], t) => [Math.min(least, t), Math.max(most, t)], [Infinity, -Infinity]);
  return Number.isFinite(from) && to > from ? [from, to] : [from || 0, (from || 0) + 1];
}

function timelineCard(page, entries) {
  const readout = make("span", { class: "readout dim" });
  const totals = page.runs.reduce((sum, run) => sum + (timeline.what === "fault" ? run.totals.faults : run.totals.triggers), 0);
  const all = page.diff ? timeline.entries.length + page.diff.left_out : totals;
  const rest = (all > timeline.entries.length ? `${count(timeline.entries.length)} of ` : "") + counted(all, timeline.what);
  const show = (t) => { readout.textContent = t === null ? rest : [seconds(t), date(page.runs[0], t)].filter(Boolean).join("  ·  "); };
  timeline.hoverListeners.push(show);
  show(null);
  const has = timeline.entries.length > 0;
  const button = (text, title, does) => make("button", { text, title, disabled: !has, on: { click: does } });
  const bar = make("div", { class: "bar" }, make("b", { text: "Time line" }), readout,
    button("←", "the one before", () => step(-1)), button("→", "the next one", () => step(1)),
    make("button", { text: "All", title: "show all of the drive", on: { click: zoomOut } }));
  const [lanes, curves] = [make("div"), make("div")];
  const left = page.runs.reduce((sum, run) => sum + run.totals.curves_omitted, 0);
  const hint = make("p", { class: "hint", text: "Drag to zoom, double click for all; ctrl and wheel zoom, shift and wheel move. ← and → go from one to the next. Curves are what the lambda read; where it did not look, there is no line." });
  const none = page.runs.every((run) => run.curves.length === 0)
    ? make("p", { class: "hint", text: page.runs.every((run) => run.config === null)
      ? "No signals were kept (signals.json): a replay keeps what the lambda reads." : "The lambda read no numbers of its inputs." }) : null;
  const section = make("section", { class: "card" }, bar, lanes, curves, none ?? hint,
    left > 0 ? make("p", { class: "more", text: `${counted(left, "more field")} that the lambda looked up have no curve.` }) : null);
  return { section, draw: () => { drawLanes(lanesOf(page, entries), lanes); drawCurves(page, entries, curves); } };
}

/** Cards of each run, side by side where there is room. */
function cardsOf(page, build) {
  const several = page.runs.length > 1;
  return page.runs.map((run, index) => build(run, several ? `${"AB"[index]}: ` : ""));
}

function listenToKeys() {
  document.addEventListener("keydown", (event) => {
    if (event.target instanceof HTMLInputElement || event.ctrlKey || event.metaKey || event.altKey) return;
    const does = { ArrowRight: () => step(1), ArrowLeft: () => step(-1), Escape: () => { choose(null); zoomOut(); } }[event.key];
    if (!does) return;
    event.preventDefault();
    does();
  });
}

function main() {
  const page = JSON.parse(document.getElementById("data").textContent);
  applyTheme();
  followSystem();
  const entries = entriesOf(page);
  // A lambda that only faulted has nothing better to go through.
  const isThere = (kind) => entries.some((entry) => entry.kind === kind);
  timeline.what = page.diff ? "difference" : isThere("trigger") || !isThere("fault") ? "trigger" : "fault";
  timeline.entries = entries.filter((entry) => entry.kind === timeline.what);
  timeline.all = timeline.view = spanOf(page, entries);

  drawHead(page, document.getElementById("head"));
  const time = timelineCard(page, entries);
  const place = document.getElementById("page");
  const pair = (...cards) => make("div", { class: "pair" }, cards.flat());
  place.append(...[
    page.diff ? pair(differenceCard(page, entries), changeCard(page)) : null,
    make("div", { class: "wide" }, make("div", {}, time.section, cardsOf(page, (run, name) => galleryCard(run, name, entries))), detailsPanel(page)),
    ...cardsOf(page, faultCard),
    pair(spreadCards(page)),
    pair(cardsOf(page, lossCard), cardsOf(page, (run, name) => clipCard(run, name, entries))),
    ...cardsOf(page, logCard),
  ].filter(Boolean));
  document.getElementById("foot").textContent = `Made by ${page.made_by}. This page is complete in itself and loads nothing.`;
  // Plots are as wide as their places, which have a width now.
  time.draw();
  listenToKeys();
  point(timeline.entries[0] ?? null);
}

main();
