// Builds elements of the page. Text from files is inserted as text, never as HTML.

/** An element `tag` with `children` and with `given`: class, text, event handlers in `on`, other keys are attributes. */
function make(tag, given = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(given)) {
    if (value === undefined || value === null || value === false) continue;
    if (key === "class") element.className = value;
    else if (key === "text") element.textContent = value;
    else if (key === "on") for (const [event, handler] of Object.entries(value)) element.addEventListener(event, handler);
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

/** A definition list of the pairs in `list` that have a value. */
function terms(list) {
  const known = list.filter(([, value]) => value !== null && value !== undefined && value !== "");
  return make("dl", {}, known.flatMap(([term, value]) => [make("dt", { text: term }), make("dd", {}, value)]));
}

/** A table. `columns` are `{ title, number, text, of(row) }`; `at(row)`, if given, is called when a row is clicked. */
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

/** A note below an incomplete list with the number of missing items; null if the list is complete. */
function more(shown, total, what, where) {
  if (total <= shown) return null;
  return make("p", { class: "more", text: `${count(total - shown)} more ${what} are not on this page; all are in ${where}.` });
}
