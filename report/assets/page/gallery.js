// Camera pictures at the triggers.

function galleryCard(run, name, entries) {
  if (run.pictures.length === 0) return null;
  const shown = new Map();
  const pictures = run.pictures.map((picture, at) => {
    const of = entries.filter((entry) => entry.run === run && entry.mark?.pictures?.includes(at));
    const [first] = of;
    const title = first ? first.title + (of.length > 1 ? ` and ${count(of.length - 1)} more` : "") : picture.source;
    const score = first && first.score !== null ? `${number(first.score)} · ` : "";
    const button = make("button", { title: pictureWords(picture), on: { click: () => (first ? choose(first) : goTo(picture.t)) } },
      make("img", { src: picture.src, alt: title, loading: "lazy" }),
      make("span", {}, make("b", { text: title }), make("span", { class: "dim", text: score + seconds(picture.t) })));
    of.forEach((entry) => shown.set(entry, button));
    return button;
  });
  let chosen = null;
  timeline.choiceListeners.push((entry) => {
    chosen?.classList.remove("chosen");
    chosen = shown.get(entry) ?? null;
    chosen?.classList.add("chosen");
  });
  const left = run.totals.pictures_omitted;
  return card(`${name}Pictures`, `${counted(pictures.length, "picture")} at triggers`, make("div", { class: "gallery" }, pictures),
    left > 0 ? make("p", { class: "more", text: `Pictures of ${count(left)} more triggers or clips are omitted.` }) : null);
}
