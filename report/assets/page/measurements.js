// Draws a page of measurements: for each section its plots, and its tables below.

const PLOT_PX = 300;

/** Ticks between `least` and `most` on a logarithmic axis. */
function powersBetween(least, most) {
  const decades = Math.log10(most / least);
  const digits = decades > 3 ? [1] : decades > 1.2 ? [1, 2, 5] : [1, 1.5, 2, 3, 5, 7];
  const ticks = [];
  for (let power = Math.floor(Math.log10(least)); power <= Math.log10(most); power += 1) {
    ticks.push(...digits.map((digit) => Number(`${digit}e${power}`)));
  }
  return ticks.filter((tick) => tick >= least && tick <= most);
}

/** The columns of uPlot: all values of x, and for each curve its y or null. */
function joined(curves) {
  const places = [...new Set(curves.flatMap(({ points }) => points.map(([x]) => x)))].sort((a, b) => a - b);
  const columns = curves.map(({ points }) => {
    const values = new Map(points);
    return places.map((x) => values.get(x) ?? null);
  });
  return [places, ...columns];
}

function drawPlot(plot, place) {
  const data = joined(plot.curves);
  const [least, most] = [data[0][0], data[0].at(-1)];
  const axis = { font: "11px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif", stroke: () => colour("dim"), grid: { stroke: () => colour("faint"), width: 1 }, ticks: { show: false } };
  const range = plot.is_x_logarithmic ? [least / 1.1, most * 1.1] : [least, most];
  const logarithmic = { distr: 3, range: () => range };
  const ticks = { filter: (_, splits) => splits, splits: () => powersBetween(...range) };
  const options = {
    width: Math.max(place.clientWidth, 300), height: PLOT_PX,
    padding: [10, 16, 0, 0],
    cursor: { drag: { x: false, y: false }, points: { show: false } },
    legend: { live: false },
    // From zero, so that heights can be compared.
    scales: { x: { time: false, ...(plot.is_x_logarithmic ? logarithmic : {}) }, y: { range: (_, low, high) => [Math.min(low, 0), high * 1.05] } },
    axes: [
      { ...axis, label: plot.x, size: 30, labelSize: 20, ...(plot.is_x_logarithmic ? ticks : {}), values: (_, splits) => splits.map(number) },
      { ...axis, label: plot.y, size: 56, labelSize: 20 },
    ],
    series: [{}, ...plot.curves.map(({ name }, index) => ({ label: name, stroke: () => paletteColour(index), width: 1.6, dash: index >= PALETTE / 2 ? [6, 4] : undefined, spanGaps: true, points: { show: plot.curves[index].points.length < 20, size: 5 } }))],
  };
  keepWidth(new uPlot(options, data, place), place);
}

/** A table of texts; a column is of numbers if most of its cells begin with one. */
function textTable({ heads, rows }) {
  const isNumber = (at) => rows.filter((row) => /^[<>+-]?\s?\d/.test(row[at] ?? "")).length * 2 > rows.length;
  const columns = heads.map((title, at) => ({ title, number: at > 0 && isNumber(at), of: (row) => cell(row[at] ?? "") }));
  return table(columns, rows);
}

function cell(text) {
  const tone = { met: "good", "not met": "bad", "not measured": "warn" }[text];
  return tone ? make("span", { class: tone, text }) : text;
}

function sectionCard(section) {
  const places = section.plots.map(() => make("div"));
  requestAnimationFrame(() => section.plots.forEach((plot, index) => {
    if (plot.curves.length > 0) drawPlot(plot, places[index]);
  }));
  return card(section.title, section.note, ...places, ...section.tables.map(textTable));
}

function main() {
  const page = JSON.parse(document.getElementById("data").textContent);
  applyTheme();
  followSystem();
  document.title = page.title;
  document.getElementById("head").append(make("div", { class: "name" }, make("h1", { text: page.title }), make("span", { class: "grow" }), themeButton()), make("p", { class: "origin", text: page.origin }));
  const list = (title, texts) => (texts.length > 0 ? card(title, null, make("ul", {}, texts.map((text) => make("li", { text })))) : null);
  const after = [list("Notes", page.notes), card("Machine", null, terms(page.facts)), list("Recommendation", page.recommendation)];
  document.getElementById("page").append(...[...page.sections.map(sectionCard), ...after].filter(Boolean));
  document.getElementById("foot").textContent = "This page is self-contained and loads nothing.";
}

main();
