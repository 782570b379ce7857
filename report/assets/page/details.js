// What is known of the chosen trigger, fault, clip or difference, beside the time line.

const AROUND_S = 2;
const AROUND_LINES = 30;

/** The place for details; it follows what is chosen. */
function detailsPanel(page) {
  const panel = make("aside", { class: "card", "aria-live": "polite" });
  const show = (entry) => panel.replaceChildren(...(entry ? detailsOf(page, entry) : nothingChosen(page)));
  timeline.choiceListeners.push(show);
  show(null);
  return panel;
}

function nothingChosen(page) {
  const { what } = timeline;
  const has = timeline.entries.length > 0;
  return [
    make("h2", { text: has ? `Choose a ${what}` : "Nothing to choose" }),
    make("p", { class: "dim", text: has
      ? `Click a mark on the time line, or press → for the first ${what}.`
      : page.diff ? "The decisions of both runs are the same." : "This lambda did not trigger." }),
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

/** As `entryColour`, for an element of the page. */
function entryStyle(entry) {
  if (entry.kind === "fault") return "var(--bad)";
  if (entry.kind === "difference") return `var(--${{ gone: "bad", new: "good", changed: "warn" }[entry.is]})`;
  return paletteStyle(entry.colour);
}

function triggerDetails({ run, mark }) {
  const pictures = mark.pictures.map((at) => run.pictures[at]);
  const shown = pictures.map((picture) => [
    make("img", { src: picture.src, alt: picture.of }),
    make("p", { class: "more", text: pictureWords(picture) }),
  ]);
  const attributes = mark.attributes.map(([name, value]) => [name, make("span", { class: "mono", text: value })]);
  return [
    ...shown.flat(),
    terms([
      ["score", mark.score === null ? null : make("b", { text: String(mark.score) })],
      ...attributes,
      ["attributes", mark.attributes_cut ? "more than this page has room for; see decisions.jsonl" : null],
    ]),
    terms([
      ["kind", mark.kind],
      ["woken by", mark.cause === "tick" ? "the clock" : mark.topic],
      ["sample", mark.seq],
      ["took", nanoseconds(mark.run_ns)],
      ["fuel", mark.fuel === null ? null : count(mark.fuel)],
    ]),
  ];
}

function pictureWords(picture) {
  if (picture.age === null) return `thumbnail of ${picture.of}`;
  return picture.age < 0.0005 ? picture.of : `${picture.of}, ${picture.age.toFixed(3)} s before`;
}

function faultDetails({ mark }) {
  return [make("pre", { text: mark.message }), terms([["used", mark.amounts.used], ["allowed", mark.amounts.allowed], ["woken by", mark.topic ?? "the clock"]])];
}

function clipDetails({ clip }) {
  return [
    terms([["file", make("code", { text: clip.file })], ["size", bytes(clip.bytes)], ["triggers", count(clip.triggers)], ["holds", clip.contents]]),
    ...clip.short.map((why) => make("p", { class: "warn", text: why })),
  ];
}

/** What is said of it, and what each run has there. */
function differenceDetails({ difference }, page) {
  const isThere = (mark) => Math.abs(mark.t - difference.t) < 5e-7;
  const of = page.runs.flatMap((run, index) => [
    ...run.triggers.filter(isThere).map((mark) => [make("h2", {}, swatch(paletteStyle(index)), `${"AB"[index]}: ${run.labels[mark.label]}`), ...triggerDetails({ run, mark })]),
    ...run.faults.filter(isThere).map((mark) => [make("h2", {}, swatch(paletteStyle(index)), `${"AB"[index]}: fault`), ...faultDetails({ mark })]),
  ]);
  return [
    terms([["what", `${difference.of}, ${difference.is}`], ["before → after", difference.is === "changed" ? difference.detail : null]]),
    ...of.flat(),
  ];
}

/** What the lambda logged near; `of` tells two runs apart. */
function logAround(run, entry, of) {
  const end = (entry.to ?? entry.t) + AROUND_S;
  const near = run.log.filter((line) => line.t >= entry.t - AROUND_S && line.t <= end).slice(0, AROUND_LINES);
  if (near.length === 0) return [];
  return [make("h2", { text: `Log around it${of}` }), logLines(near, "lines narrow")];
}

/** Lines of a log. */
function logLines(lines, kind) {
  return make("div", { class: kind }, lines.map((line) => make("div", { class: plainLevel(line.level) },
    make("span", { class: "at", text: line.t.toFixed(3) }),
    make("span", { class: "level", text: line.level }),
    make("span", { class: "text", text: line.message }))));
}

/** A class of the style sheet; levels are texts from a file. */
function plainLevel(level) {
  return { error: "error", warn: "warn" }[level] ?? null;
}
