// Histograms of the cost of a wake, on logarithmic scales.

const SPREAD_PX = 190;

/** A card for each measured quantity; two runs share it. */
function spreadCards(page) {
  const names = [...new Set(page.runs.flatMap((run) => run.spreads.map((spread) => spread.what)))];
  return names.map((what) => {
    const of = page.runs.map((run, index) => ({ index, spread: run.spreads.find((spread) => spread.what === what) }));
    return spreadCard(what, of.filter(({ spread }) => spread && spread.count > 0), page.runs.length > 1);
  });
}

function spreadCard(what, of, several) {
  const title = `${what[0].toUpperCase()}${what.slice(1)} per wake`;
  if (of.length === 0) return card(title, null, make("p", { class: "dim", text: "No wakes." }));
  const place = make("div");
  const columns = [
    ...(several ? [{ title: "", of: ({ index }) => make("span", {}, swatch(paletteStyle(index)), "AB"[index]) }] : []),
    { title: "wakes", number: true, of: ({ spread }) => count(spread.count) },
    ...of[0].spread.quantiles.map(([name], at) => ({ title: name, number: true, of: ({ spread }) => amount(spread.quantiles[at]?.[1] ?? 0, spread.unit) })),
  ];
  const section = card(title, null, place, table(columns, of));
  const drawn = of.filter(({ spread }) => spread.bins.length > 0);
  if (drawn.length > 0) requestAnimationFrame(() => drawSpread(drawn, place, several));
  return section;
}

function drawSpread(of, place, several) {
  const { unit } = of[0].spread;
  const bins = of.flatMap(({ spread }) => spread.bins);
  // Zero is drawn at the left end, since a logarithmic scale has no zero.
  const least = Math.max(1, Math.min(...bins.map(([from]) => from)));
  const most = Math.max(least * 2, ...bins.map(([, to]) => to));
  const tallest = Math.max(...bins.map(([, , wakes]) => wakes));
  const axis = { font: "11px system-ui, sans-serif", stroke: () => colour("dim"), grid: { stroke: () => colour("faint"), width: 1 }, ticks: { show: false } };
  const [left, right, top] = [least / 1.15, most * 1.15, tallest * 1.6];
  const all = (_, splits) => splits;
  const options = {
    width: Math.max(place.clientWidth, 300), height: SPREAD_PX,
    padding: [14, 16, 0, 0],
    legend: { show: false },
    cursor: { show: false },
    scales: { x: { time: false, distr: 3, range: () => [left, right] }, y: { distr: 3, range: () => [0.7, top] } },
    axes: [
      { ...axis, size: 24, filter: all, splits: () => roundBetween(left, right), values: (_, splits) => splits.map((value) => amount(value, unit)) },
      { ...axis, size: 64, filter: all, splits: () => roundBetween(0.7, top), values: (_, splits) => splits.map(count) },
    ],
    series: [{}, { show: true, points: { show: false } }],
    hooks: { draw: [(plot) => of.forEach((one) => drawBins(plot, one, several, least))] },
  };
  keepWidth(new uPlot(options, [[least, most], [null, null]], place), place);
}

/** Ticks from `least` to `most`: 1, 2 and 5 times powers of ten, or only powers of ten if there are many. */
function roundBetween(least, most) {
  const digits = Math.log10(most / least) > 2.5 ? [1] : [1, 2, 5];
  const numbers = [];
  for (let power = Math.floor(Math.log10(least)); power <= Math.log10(most); power += 1) {
    numbers.push(...digits.map((digit) => Number(`${digit}e${power}`)));
  }
  return numbers.filter((number) => number >= Math.max(least, 1) && number <= most);
}

function drawBins(plot, { index, spread }, several, least) {
  const { ctx, bbox } = plot;
  const tone = paletteColour(index);
  const floor = bbox.top + bbox.height;
  ctx.save();
  ctx.fillStyle = faded(tone, several ? 0.45 : 0.75);
  for (const [from, to, wakes] of spread.bins) {
    const [left, right] = [Math.max(from, least), Math.max(to, least)].map((value) => plot.valToPos(value, "x", true));
    const top = plot.valToPos(wakes, "y", true);
    ctx.fillRect(left, top, Math.max(right - left - 1, 1), floor - top);
  }
  ctx.font = `${10 * devicePixelRatio}px system-ui, sans-serif`;
  ctx.textAlign = "center";
  let before = -Infinity;
  for (const [name, value] of spread.quantiles) {
    const x = plot.valToPos(Math.max(value, least), "x", true);
    ctx.fillStyle = several ? tone : colour("ink");
    ctx.fillRect(x, bbox.top, Math.max(1, devicePixelRatio / 1.5), bbox.height);
    const wide = ctx.measureText(name).width;
    if (several || x - wide / 2 < before + 6) continue;
    before = x + wide / 2;
    ctx.fillText(name, x, bbox.top - 4 * devicePixelRatio);
  }
  ctx.restore();
}
