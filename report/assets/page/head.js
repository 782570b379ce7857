// The head of the page: lambda, drive, and results at a glance.

function drawHead(page, place) {
  const [run] = page.runs;
  const title = page.diff ? `${run.lambda}: two runs` : run.lambda;
  document.title = `${title} – Gleaner`;
  place.append(make("div", { class: "name" },
    make("h1", { text: title }),
    page.diff ? null : badges(run),
    make("span", { class: "grow" }),
    themeButton()));
  if (page.diff) {
    place.append(make("div", { class: "runs" }, page.runs.map((one, index) => make("div", {},
      make("div", { class: "name" }, make("b", {}, swatch(paletteStyle(index)), `${"AB"[index]} ${one.lambda}`), badges(one)),
      origin(one), tiles(one), chips(one)))));
  } else {
    place.append(origin(run), tiles(run), chips(run));
  }
  banners(page).forEach((banner) => place.append(banner));
}

function badges(run) {
  const words = [run.version, run.kind, run.is_live ? "live" : "replay"];
  return words.map((word) => make("span", { class: "badge", text: word }));
}

/** The drive, the part of it, and the result folder. */
function origin(run) {
  const drive = run.is_live ? "live topics" : run.drive.join(", ");
  const part = run.is_part ? `, only ${seconds(run.from)} to ${seconds(run.to)}` : "";
  const when = date(run, run.from);
  const span = `${(run.to - run.from).toFixed(1)} s`;
  return make("p", { class: "origin", text: [drive + part, span, when, `results in ${run.out}`].filter(Boolean).join("  ·  ") });
}

function tiles(run) {
  const { wakes, triggers, faults } = run.counts;
  const clips = run.totals.clips;
  const time = run.spreads.find((spread) => spread.what === "run time");
  const fuel = run.spreads.find((spread) => spread.unit === "fuel");
  const median = (spread) => spread.quantiles.find(([name]) => name === "p50")[1];
  const all = [
    tile(count(wakes), "wakes"),
    tile(count(triggers), triggers === 1 ? "trigger" : "triggers", triggers > 0 ? "good" : null),
    tile(count(clips), clips === 1 ? "clip" : "clips"),
    tile(count(faults), faults === 1 ? "fault" : "faults", faults > 0 ? "bad" : null),
    lossTile(run),
    time && time.count > 0 ? tile(nanoseconds(median(time)), "run time, p50") : null,
    fuel && fuel.count > 0 ? tile(count(median(fuel)), "fuel, p50") : null,
  ];
  return make("div", { class: "tiles" }, all);
}

function tile(value, what, kind) {
  return make("div", { class: "tile" }, make("b", { class: kind, text: value }), make("span", { text: what }));
}

/** Number of lost samples, as far as it is known. */
function lossTile(run) {
  const lost = run.topics.reduce((sum, topic) => sum + lostOf(topic), 0);
  const unknown = run.topics.filter((topic) => topic.lost === null).length;
  if (lost === 0 && unknown > 0) return tile("unknown", unknown === run.topics.length ? "samples lost" : `samples lost, of ${counted(unknown, "topic")}`);
  return tile(count(lost), unknown > 0 ? `samples lost; unknown of ${counted(unknown, "topic")}` : "samples lost", lost > 0 ? "warn" : null);
}

/** Number of samples of a topic that are known to be lost. */
function lostOf(topic) {
  return (topic.lost ?? 0) + topic.no_slot + topic.too_big + (topic.malformed ?? 0);
}

/** The config of the run, and its cost. */
function chips(run) {
  const chip = (what, value) => make("span", {}, make("span", { text: what }), value);
  const config = run.config
    ? Object.entries(run.config).map(([key, value]) => chip(key, make("b", { class: "mono", text: String(value) })))
    : [chip("config", "unknown")];
  return make("div", { class: "chips" }, config, run.facts.map((fact) => chip(fact.what, fact.text)));
}

function banners(page) {
  const banner = (kind, title, text) => make("div", { class: kind }, make("b", { text: title }), text);
  const several = page.runs.length > 1;
  const all = (page.diff?.notes ?? []).map((note) => banner("banner", "", note));
  page.runs.forEach((run, index) => {
    const name = several ? `${"AB"[index]}: ` : "";
    if (run.damaged) all.push(banner("banner bad", `${name}The drive is damaged. `, run.damaged));
    if (run.stopped) all.push(banner("banner bad", `${name}The lambda's process ended before the drive did; the results end there. `, run.stopped));
    run.notes.forEach((note) => all.push(banner("banner", "", name + note)));
    const { shown, total } = { shown: run.triggers.length, total: run.totals.triggers };
    if (shown < total) all.push(banner("banner", "", `${name}${count(shown)} of ${count(total)} triggers are on this page with details; bars on the timeline show where the others are. All are in decisions.jsonl.`));
  });
  return all;
}
