// Details of the chosen trigger, fault, clip or difference, beside the timeline.

const AROUND_S = 2;
const AROUND_LINES = 30;

/** The panel for details of the chosen entry. */
function detailsPanel(page) {
  const panel = make("aside", { class: "card", "aria-live": "polite" });
  const show = (entry) => panel.replaceChildren(...(entry ? detailsOf(page, entry) : nothingChosen(page)));
  timeline.choiceListeners.push(show);
  show(null);
  return panel;
}

function nothingChosen(page) {
  const { kind } = timeline;
  const has = timeline.entries.length > 0;
  return [
    make("h2", { text: has ? `Choose a ${kind}` : "Nothing to choose" }),
    make("p", { class: "dim", text: has
      ? `Click a mark on the timeline, or press → for the first ${kind}.`
      : page.diff ? "The decisions of both runs are identical." : "This lambda did not trigger." }),
  ];
}

function detailsOf(page, entry) {
  const { run } = entry;
  const heading = make("h2", {}, swatch(entryStyle(entry)), entry.title);
  const when = make("p", { class: "dim" }, entry.to ? `${seconds(entry.t)} to ${seconds(entry.to)}` : seconds(entry.t), make("br"), date(run, entry.t));
  const parts = { trigger: triggerDetails, fault: faultDetails, clip: clipDetails, difference: differenceDetails }[entry.kind](entry, page);
  const runs = entry.kind === "difference" ? page.runs : [run];
  return [heading, when, ...parts, ...runs.flatMap((run, index) => logAround(run, entry, runs.length > 1 ? `, ${"AB"[index]}` : ""))];
}

/** `entryColour` as a CSS value. */
function entryStyle(entry) {
  if (entry.kind === "fault") return "var(--bad)";
  if (entry.kind === "difference") return `var(--${{ removed: "bad", added: "good", changed: "warn" }[entry.change]})`;
  return paletteStyle(entry.colour);
}

function triggerDetails({ run, mark }) {
  const pictures = mark.pictures.map((at) => run.pictures[at]);
  const shown = pictures.map((picture) => [
    make("img", { src: picture.src, alt: picture.source }),
    make("p", { class: "more", text: pictureWords(picture) }),
  ]);
  const attributes = mark.attributes.map(([name, value]) => [name, make("span", { class: "mono", text: value })]);
  return [
    ...shown.flat(),
    terms([
      ["score", mark.score === null ? null : make("b", { text: String(mark.score) })],
      ...attributes,
      ["attributes", mark.attributes_omitted ? "too large for this page; see decisions.jsonl" : null],
    ]),
    terms([
      ["kind", mark.kind],
      ["cause", mark.cause === "tick" ? "tick" : mark.topic],
      ["sample", mark.seq],
      ["run time", nanoseconds(mark.run_ns)],
      ["fuel", mark.fuel === null ? null : count(mark.fuel)],
    ]),
  ];
}

function pictureWords(picture) {
  if (picture.age === null) return `thumbnail of ${picture.source}`;
  return picture.age < 0.0005 ? picture.source : `${picture.source}, ${picture.age.toFixed(3)} s before`;
}

function faultDetails({ mark }) {
  return [make("pre", { text: mark.message }), terms([["used", mark.amounts.used], ["allowed", mark.amounts.allowed], ["cause", mark.topic ?? "tick"]])];
}

function clipDetails({ clip }) {
  return [
    terms([["file", make("code", { text: clip.file })], ["size", bytes(clip.bytes)], ["triggers", count(clip.triggers)], ["contents", clip.contents]]),
    ...clip.incomplete.map((why) => make("p", { class: "warn", text: why })),
  ];
}

/** The difference, and what each run has at its time. */
function differenceDetails({ difference }, page) {
  const isThere = (mark) => Math.abs(mark.t - difference.t) < 5e-7;
  const of = page.runs.flatMap((run, index) => [
    ...run.triggers.filter(isThere).map((mark) => [make("h2", {}, swatch(paletteStyle(index)), `${"AB"[index]}: ${run.labels[mark.label]}`), ...triggerDetails({ run, mark })]),
    ...run.faults.filter(isThere).map((mark) => [make("h2", {}, swatch(paletteStyle(index)), `${"AB"[index]}: fault`), ...faultDetails({ mark })]),
  ]);
  return [
    terms([["what", `${difference.kind}, ${difference.change}`], ["before → after", difference.change === "changed" ? difference.detail : null]]),
    ...of.flat(),
  ];
}

/** Log lines near the entry; `name` distinguishes two runs. */
function logAround(run, entry, name) {
  const end = (entry.to ?? entry.t) + AROUND_S;
  const near = run.log.filter((line) => line.t >= entry.t - AROUND_S && line.t <= end).slice(0, AROUND_LINES);
  if (near.length === 0) return [];
  return [make("h2", { text: `Log lines at this time${name}` }), logLines(near, "lines narrow")];
}

/** Lines of a log. */
function logLines(lines, kind) {
  return make("div", { class: kind }, lines.map((line) => make("div", { class: plainLevel(line.level) },
    make("span", { class: "at", text: line.t.toFixed(3) }),
    make("span", { class: "level", text: line.level }),
    make("span", { class: "text", text: line.message }))));
}

/** The CSS class of a level. Levels are untrusted texts. */
function plainLevel(level) {
  return { error: "error", warn: "warn" }[level] ?? null;
}
