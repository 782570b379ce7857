// Reads the data, draws the page and handles keys.

/** All entries of the timeline, by time. */
function entriesOf(page) {
  const several = page.runs.length > 1;
  const entries = page.runs.flatMap((run, index) => [
    ...run.triggers.map((mark) => ({ kind: "trigger", run, t: mark.t, label: mark.label, colour: several ? index : mark.label, score: mark.score, title: run.labels[mark.label], mark })),
    ...run.faults.map((mark) => ({ kind: "fault", run, t: mark.t, title: `fault: ${plain(run.fault_kinds[mark.lane])}`, mark })),
    ...run.clips.map((clip) => ({ kind: "clip", run, t: clip.from, to: Math.max(clip.to, clip.from + 1e-6), colour: index, title: "clip", clip })),
  ]);
  const differences = (page.diff?.differences ?? []).map((difference) => ({
    kind: "difference", run: page.runs[0], t: difference.t, change: difference.change, title: `${difference.label}, ${difference.change}`, difference,
  }));
  return [...entries, ...differences].sort((a, b) => a.t - b.t);
}

/** Time span of all runs and entries. */
function spanOf(page, entries) {
  const times = page.runs.flatMap((run) => [run.from, run.to]).concat(entries.flatMap((entry) => (entry.kind === "clip" ? [] : [entry.t])));
  const [from, to] = times.reduce(([least, most], t) => [Math.min(least, t), Math.max(most, t)], [Infinity, -Infinity]);
  return Number.isFinite(from) && to > from ? [from, to] : [from || 0, (from || 0) + 1];
}

function timelineCard(page, entries) {
  const readout = make("span", { class: "readout dim" });
  const totals = page.runs.reduce((sum, run) => sum + (timeline.kind === "fault" ? run.totals.faults : run.totals.triggers), 0);
  const all = page.diff ? timeline.entries.length + page.diff.omitted : totals;
  const rest = (all > timeline.entries.length ? `${count(timeline.entries.length)} of ` : "") + counted(all, timeline.kind);
  const show = (t) => { readout.textContent = t === null ? rest : [seconds(t), date(page.runs[0], t)].filter(Boolean).join("  ·  "); };
  timeline.hoverListeners.push(show);
  show(null);
  const has = timeline.entries.length > 0;
  const button = (text, title, handler) => make("button", { text, title, disabled: !has, on: { click: handler } });
  const bar = make("div", { class: "bar" }, make("b", { text: "Timeline" }), readout,
    button("←", "previous", () => step(-1)), button("→", "next", () => step(1)),
    make("button", { text: "All", title: "show the whole drive", on: { click: zoomOut } }));
  const [lanes, curves] = [make("div"), make("div")];
  const left = page.runs.reduce((sum, run) => sum + run.totals.curves_omitted, 0);
  const hint = make("p", { class: "hint", text: "Drag to zoom, double-click to reset; Ctrl + wheel zooms, Shift + wheel pans. ← and → go to the previous and next entry. Curves show the fields that the lambda read; where it did not read, there is no line." });
  const none = page.runs.every((run) => run.curves.length === 0)
    ? make("p", { class: "hint", text: page.runs.every((run) => run.config === null)
      ? "No signals were recorded (signals.json): only a replay records what the lambda reads." : "The lambda read no numeric fields." }) : null;
  const section = make("section", { class: "card" }, bar, lanes, curves, none ?? hint,
    left > 0 ? make("p", { class: "more", text: `Curves of ${counted(left, "more field")} are omitted.` }) : null);
  return { section, draw: () => { drawLanes(lanesOf(page, entries), lanes); drawCurves(page, entries, curves); } };
}

/** A card for each run. */
function cardsOf(page, build) {
  const several = page.runs.length > 1;
  return page.runs.map((run, index) => build(run, several ? `${"AB"[index]}: ` : ""));
}

function handleKeys() {
  document.addEventListener("keydown", (event) => {
    if (event.target instanceof HTMLInputElement || event.ctrlKey || event.metaKey || event.altKey) return;
    const handler = { ArrowRight: () => step(1), ArrowLeft: () => step(-1), Escape: () => { choose(null); zoomOut(); } }[event.key];
    if (!handler) return;
    event.preventDefault();
    handler();
  });
}

function main() {
  const page = JSON.parse(document.getElementById("data").textContent);
  applyTheme();
  followSystem();
  const entries = entriesOf(page);
  // The arrow keys go through faults only if there are no triggers.
  const isThere = (kind) => entries.some((entry) => entry.kind === kind);
  timeline.kind = page.diff ? "difference" : isThere("trigger") || !isThere("fault") ? "trigger" : "fault";
  timeline.entries = entries.filter((entry) => entry.kind === timeline.kind);
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
  document.getElementById("foot").textContent = `Made by ${page.made_by}. This page is self-contained and loads nothing.`;
  // Plots take the width of their elements, which is known only now.
  time.draw();
  handleKeys();
  point(timeline.entries[0] ?? null);
}

main();
