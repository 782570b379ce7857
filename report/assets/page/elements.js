// Elements of the page. Text from files comes in as text and never as HTML.

/** An element `tag` with `given` (its class, title, text, what it does on events; all else are attributes) and `children`. */
function make(tag, given = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(given)) {
    if (value === undefined || value === null || value === false) continue;
    if (key === "class") element.className = value;
    else if (key === "text") element.textContent = value;
    else if (key === "on") for (const [event, does] of Object.entries(value)) element.addEventListener(event, does);
    else element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

/** A section with a title, as a card of the page. */
function card(title, note, ...children) {
  const heading = make("h2", { text: title }, note ? make("span", { class: "dim", text: note }) : null);
  return make("section", { class: "card" }, heading, ...children);
}

/** A small square in `colour`, a CSS colour. */
function swatch(colour) {
  const square = make("span", { class: "swatch" });
  square.style.background = colour;
  return square;
}

/** The pairs of `list` as a list of terms; pairs without a value are left out. */
function terms(list) {
  const known = list.filter(([, value]) => value !== null && value !== undefined && value !== "");
  return make("dl", {}, known.flatMap(([term, value]) => [make("dt", { text: term }), make("dd", {}, value)]));
}

/** A table. `columns` are `{ title, number, text, of(row) }`; `at(row)` gives what a click on a row goes to. */
function table(columns, rows, at) {
  const kind = (column) => (column.number ? "number" : column.text ? "text" : null);
  const head = make("tr", {}, columns.map((column) => make("th", { class: kind(column), text: column.title })));
  const body = rows.map((row) => {
    const cells = columns.map((column) => make("td", { class: kind(column) }, column.of(row) ?? ""));
    if (!at) return make("tr", {}, cells);
    const go = () => at(row);
    const keys = (event) => { if (event.key === "Enter") go(); };
    return make("tr", { class: "at", tabindex: 0, on: { click: go, keydown: keys } }, cells);
  });
  return make("div", { class: "scroll" }, make("table", {}, make("thead", {}, head), make("tbody", {}, body)));
}

/** A line below a list that says how much is not in it; nothing if nothing is missing. */
function more(shown, total, what, where) {
  if (total <= shown) return null;
  return make("p", { class: "more", text: `${count(total - shown)} more ${what} are not on this page; all are in ${where}.` });
}
