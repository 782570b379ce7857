// Tables of the differences between two runs.

function differenceCard(page, entries) {
  const { diff } = page;
  if (!diff) return null;
  const verdict = diff.identical ? make("p", { class: "good", text: "All decisions are identical." }) : null;
  const row = ([what, counts]) => ({ what, ...counts });
  const counts = table([
    { title: "", of: (row) => make("b", { text: row.what }) },
    ...["identical", "removed", "added", "changed"].map((word) => ({ title: word, number: true, of: (row) => count(row[word]) })),
  ], [["triggers", diff.triggers], ["faults", diff.faults]].map(row));
  const columns = [
    { title: "time", number: true, of: ({ difference }) => seconds(difference.t) },
    { title: "", of: (entry) => make("span", {}, swatch(entryStyle(entry)), entry.change) },
    { title: "what", of: ({ difference }) => make("b", { text: difference.kind === "fault" ? `fault: ${plain(difference.label)}` : difference.label }) },
    { title: "before → after", text: true, of: ({ difference }) => difference.detail },
    { title: "topic", of: ({ difference }) => make("code", { text: difference.topic ?? "" }) },
  ];
  const rows = entries.filter((entry) => entry.kind === "difference");
  return card("Decisions that differ", "removed: only in A; added: only in B", verdict, counts,
    rows.length > 0 ? table(columns, rows, choose) : null,
    more(rows.length, rows.length + diff.omitted, "differences", "the files decisions.jsonl of both"));
}

/** Config, counts and costs that differ. */
function changeCard(page) {
  const { diff } = page;
  if (!diff) return null;
  const word = (value) => value ?? "unknown";
  const rows = [
    ...diff.config.map(({ what, a, b }) => [`config ${what}`, word(a), word(b), ""]),
    ...diff.counts.map(({ what, a, b }) => [what, word(a), word(b), ""]),
    ...diff.cost.map(({ what, unit, a, b, ratio }) => [`${what}, p50`, ...[a, b].map((value) => (value === null ? "unknown" : amount(value, unit))), ratio === null ? "" : `x${Number(ratio.toPrecision(3))}`]),
  ];
  if (rows.length === 0) return null;
  const columns = [
    { title: "", of: ([what]) => what },
    { title: "A", number: true, of: ([, a]) => a },
    { title: "B", number: true, of: ([, , b]) => b },
    { title: "", number: true, of: ([, , , by]) => by },
  ];
  return card("Other differences", null, table(columns, rows));
}
