// Light and dark. Canvases are drawn in colours of the style sheet, so they are drawn again when those change.

const PALETTE = 8;
const themeListeners = [];

/** Asked for once in each theme: plots need them thousands of times. */
const colours = new Map();

/** The colour `name` of the style sheet. */
function colour(name) {
  if (!colours.has(name)) colours.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
  return colours.get(name);
}

/** The colour of the `index`th thing. */
function paletteColour(index) {
  return colour(`c${index % PALETTE}`);
}

/** The same for an element of the page, which changes with the theme by itself. */
function paletteStyle(index) {
  return `var(--c${index % PALETTE})`;
}

/** `text`, a colour as `#rrggbb`, with an opacity. */
function faded(text, opacity) {
  const [red, green, blue] = [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16));
  return `rgba(${red}, ${green}, ${blue}, ${opacity})`;
}

const systemIsDark = window.matchMedia("(prefers-color-scheme: dark)");
let chosenTheme = null;
let printing = false;

function applyTheme() {
  const theme = printing ? "light" : chosenTheme ?? (systemIsDark.matches ? "dark" : "light");
  document.documentElement.dataset.theme = theme;
  colours.clear();
  themeListeners.forEach((listener) => listener());
}

/** A button that goes from light to dark and back. */
function themeButton() {
  const toggle = () => {
    chosenTheme = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
    applyTheme();
  };
  return make("button", { class: "theme", title: "light or dark", "aria-label": "light or dark", text: "◐", on: { click: toggle } });
}

/** Follows the system until the button is used; paper is light. */
function followSystem() {
  const print = (is) => () => { printing = is; applyTheme(); };
  systemIsDark.addEventListener("change", applyTheme);
  window.addEventListener("beforeprint", print(true));
  window.addEventListener("afterprint", print(false));
}
