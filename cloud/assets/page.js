"use strict";
// Additions to htmx for streams of records. The page works without any script.

// Maximum number of records that stay on the page.
const LINES_MAX = 500;

function stateOf(source, name) {
  const state = source.querySelector("[data-live]");
  if (state && state.textContent !== state.dataset[name]) state.textContent = state.dataset[name];
}

document.addEventListener("htmx:sseOpen", (event) => stateOf(event.target, "live"));
document.addEventListener("htmx:sseError", (event) => stateOf(event.target, "lost"));

document.addEventListener("htmx:sseMessage", (event) => {
  const lines = event.target;
  lines.querySelector(".empty")?.remove();
  while (lines.childElementCount > LINES_MAX) lines.lastElementChild.remove();
  // A connection that a proxy or the server has refused is opened by htmx again, from this address.
  const source = lines.closest("[sse-connect]");
  const address = source.getAttribute("sse-connect").split("?")[0];
  source.setAttribute("sse-connect", `${address}?after=${event.detail.lastEventId}`);
});
