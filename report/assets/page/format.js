// Formats numbers and times.

const wholeNumbers = new Intl.NumberFormat("en");

/** `1,234`. */
function count(number) {
  return wholeNumbers.format(number);
}

/** A count with its word: `1 trigger`, `2 triggers`. */
function counted(number, word) {
  return `${count(number)} ${word}${number === 1 ? "" : "s"}`;
}

/** Four significant digits, without trailing zeros. */
function number(value) {
  if (value === null || value === undefined) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e6 || size < 1e-3) return value.toExponential(3).replace(/\.?0+e/, "e");
  return String(Number(value.toPrecision(size >= 1000 ? 6 : 4)));
}

/** A time in the drive: `12.345 s`. */
function seconds(t) {
  return `${t.toFixed(3)} s`;
}

/** The UTC date at `t` s after the start of the drive of `run`; empty for clocks that count from zero. */
function date(run, t) {
  const moment = new Date(run.start_ms + t * 1000);
  const isDate = run.start_ms > 1e11 && !Number.isNaN(moment.getTime());
  return isDate ? moment.toISOString().replace("T", " ").replace("Z", " UTC") : "";
}

/** A duration: `12.3 µs`. */
function nanoseconds(ns) {
  const units = [[1e9, "s"], [1e6, "ms"], [1e3, "µs"]];
  const unit = units.find(([size]) => ns >= size);
  return unit ? `${number3(ns / unit[0])} ${unit[1]}` : `${ns} ns`;
}

function number3(value) {
  return String(Number(value.toPrecision(3)));
}

/** `1.3 MiB`. */
function bytes(size) {
  if (size < 1024) return `${size} B`;
  return size < 1048576 ? `${Math.ceil(size / 1024)} KiB` : `${(size / 1048576).toFixed(1)} MiB`;
}

/** An amount of `unit`: `ns` or `fuel`. */
function amount(value, unit) {
  return unit === "ns" ? nanoseconds(value) : count(value);
}

/** A name of a file without underscores: `host_call` is `host call`. */
function plain(word) {
  return word.replaceAll("_", " ");
}

/** A count that may be unknown, which is never shown as 0. */
function known(value) {
  return value === null || value === undefined ? make("span", { class: "dim", text: "unknown" }) : count(value);
}
