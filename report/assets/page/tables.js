// Tables of losses, faults and clips, and the log.

/** Received and lost samples of each topic, and other losses. */
function lossCard(run, name) {
  const isLive = run.topics.some((topic) => topic.malformed !== null);
  const columns = [
    { title: "input", of: (topic) => make("b", { text: topic.input, title: topic.type_name }) },
    { title: "topic", of: (topic) => make("code", { text: topic.topic }) },
    { title: "received", number: true, of: (topic) => count(topic.received) },
    { title: "lost upstream", number: true, of: (topic) => loss(topic.lost) },
    { title: "no free slot", number: true, of: (topic) => loss(topic.no_slot) },
    { title: "too big", number: true, of: (topic) => loss(topic.too_big) },
    ...(isLive ? [{ title: "malformed", number: true, of: (topic) => loss(topic.malformed) }] : []),
    { title: "overwritten", number: true, of: (topic) => make("span", { class: "dim", text: count(topic.overwritten), title: "evicted from the ring by newer samples: no loss" }) },
  ];
  const missed = run.missed.filter(([, number]) => number > 0);
  return card(`${name}Losses`, null, table(columns, run.topics),
    missed.length > 0 ? terms(missed.map(([what, number]) => [what, make("span", { class: "warn", text: count(number) })])) : null);
}

function loss(value) {
  return value > 0 ? make("span", { class: "warn", text: count(value) }) : known(value);
}

function faultCard(run, name) {
  if (run.totals.faults === 0) return null;
  const columns = [
    { title: "kind", of: (fault) => make("b", { class: "bad", text: plain(fault.kind) }) },
    { title: "times", number: true, of: (fault) => count(fault.count) },
    { title: "first", number: true, of: (fault) => seconds(fault.first) },
    { title: "last", number: true, of: (fault) => seconds(fault.last) },
    { title: "used / allowed", number: true, of: ({ amounts }) => (amounts.used || amounts.allowed ? `${amounts.used ?? "?"} / ${amounts.allowed ?? "?"}` : "") },
    { title: "message", text: true, of: (fault) => make("span", { class: "mono", text: fault.message }) },
  ];
  const rest = run.totals.unlisted_faults;
  return card(`${name}Faults`, counted(run.totals.faults, "fault"),
    table(columns, run.fault_causes, (fault) => goTo(fault.first)),
    rest > 0 ? make("p", { class: "more", text: `${counted(rest, "fault")} of other causes; all are in decisions.jsonl.` }) : null);
}

function clipCard(run, name, entries) {
  if (run.totals.clips === 0) return null;
  const columns = [
    { title: "from", number: true, of: ({ clip }) => seconds(clip.from) },
    { title: "length", number: true, of: ({ clip }) => `${(clip.to - clip.from).toFixed(1)} s` },
    { title: "triggers", number: true, of: ({ clip }) => count(clip.triggers) },
    { title: "size", number: true, of: ({ clip }) => bytes(clip.bytes) },
    { title: "file", of: ({ clip }) => [make("code", { text: clip.file }), ...clip.incomplete.map((why) => make("div", { class: "warn", text: why }))] },
  ];
  const rows = entries.filter((entry) => entry.run === run && entry.kind === "clip");
  return card(`${name}Clips`, counted(run.totals.clips, "clip"), table(columns, rows, choose), more(rows.length, run.totals.clips, "clips", "clips.jsonl"));
}

/** The log, with a search field. */
function logCard(run, name) {
  if (run.totals.log === 0) return null;
  const place = make("div");
  const show = (word) => {
    const lines = run.log.filter((line) => line.message.toLowerCase().includes(word) || line.level.toLowerCase().includes(word));
    place.replaceChildren(lines.length > 0 ? logLines(lines, "lines") : make("p", { class: "dim", text: "No matching lines." }));
  };
  const field = make("input", { type: "search", placeholder: "search", "aria-label": "search the log", on: { input: (event) => show(event.target.value.toLowerCase()) } });
  const heading = make("div", { class: "title" }, make("h2", { text: `${name}Log` }, make("span", { class: "dim", text: counted(run.totals.log, "line") })), field);
  show("");
  return make("section", { class: "card" }, heading, place, more(run.log.length, run.totals.log, "lines", "log.jsonl"));
}
