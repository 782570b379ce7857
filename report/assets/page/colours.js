// Light and dark themes. Canvases use colours of the style sheet, and are redrawn when the theme changes.

const PALETTE = 8;
const themeListeners = [];

/** Colours of the current theme, cached: plots need them thousands of times. */
const colours = new Map();

/** The colour `name` of the style sheet. */
function colour(name) {
  if (!colours.has(name)) colours.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
  return colours.get(name);
}

/** The palette colour `index`. */
function paletteColour(index) {
  return colour(`c${index % PALETTE}`);
}

/** The same as a CSS value, which follows the theme. */
function paletteStyle(index) {
  return `var(--c${index % PALETTE})`;
}

/** The colour `text`, `#rrggbb`, with an opacity. */
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

/** A button that switches the theme. */
function themeButton() {
  const toggle = () => {
    chosenTheme = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
    applyTheme();
  };
  return make("button", { class: "theme", title: "light or dark", "aria-label": "light or dark", text: "◐", on: { click: toggle } });
}

/** Follows the theme of the system until the button is used. Prints are light. */
function followSystem() {
  const print = (is) => () => { printing = is; applyTheme(); };
  systemIsDark.addEventListener("change", applyTheme);
  window.addEventListener("beforeprint", print(true));
  window.addEventListener("afterprint", print(false));
}

/** Keeps `plot` as wide as `place`, and redraws it when the theme changes. */
function keepWidth(plot, place) {
  const fit = () => {
    const width = Math.floor(place.clientWidth);
    if (width > 0 && width !== plot.width) plot.setSize({ width, height: plot.height });
  };
  new ResizeObserver(fit).observe(place);
  themeListeners.push(() => plot.redraw(false, true));
}
