// What differs between two runs, as tables.

function differenceCard(page, entries) {
  const { diff } = page;
  if (!diff) return null;
  const verdict = diff.same ? make("p", { class: "good", text: "Every decision is the same." }) : null;
  const tally = ([what, one]) => ({ what, ...one });
  const counts = table([
    { title: "", of: (row) => make("b", { text: row.what }) },
    ...["same", "gone", "new", "changed"].map((word) => ({ title: word, number: true, of: (row) => count(row[word]) })),
  ], [["triggers", diff.triggers], ["faults", diff.faults]].map(tally));
  const columns = [
    { title: "time", number: true, of: ({ difference }) => seconds(difference.t) },
    { title: "", of: (entry) => make("span", {}, swatch(entryStyle(entry)), entry.is) },
    { title: "what", of: ({ difference }) => make("b", { text: difference.of === "fault" ? `fault: ${plain(difference.label)}` : difference.label }) },
    { title: "before → after", text: true, of: ({ difference }) => difference.detail },
    { title: "topic", of: ({ difference }) => make("code", { text: difference.topic ?? "" }) },
  ];
  const rows = entries.filter((entry) => entry.kind === "difference");
  return card("Decisions that differ", "gone: only in A; new: only in B", verdict, counts,
    rows.length > 0 ? table(columns, rows, choose) : null,
    more(rows.length, rows.length + diff.left_out, "differences", "the files decisions.jsonl of both"));
}

/** Config, counts and costs that are not alike. */
function changeCard(page) {
  const { diff } = page;
  if (!diff) return null;
  const word = (value) => value ?? "unknown";
  const rows = [
    ...diff.config.map(({ what, a, b }) => [`config ${what}`, word(a), word(b), ""]),
    ...diff.counts.map(({ what, a, b }) => [what, word(a), word(b), ""]),
    ...diff.cost.map(({ what, unit, a, b, ratio }) => [`${what}, median`, ...[a, b].map((value) => (value === null ? "unknown" : amount(value, unit))), ratio === null ? "" : `x${Number(ratio.toPrecision(3))}`]),
  ];
  if (rows.length === 0) return null;
  const columns = [
    { title: "", of: ([what]) => what },
    { title: "A", number: true, of: ([, a]) => a },
    { title: "B", number: true, of: ([, , b]) => b },
    { title: "", number: true, of: ([, , , by]) => by },
  ];
  return card("What else differs", null, table(columns, rows));
}
