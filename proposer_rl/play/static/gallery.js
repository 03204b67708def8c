// Levels as pictures in a list.

import { percent, short } from "./page.js";

/** Fills a list with levels; chosen(level) is called with the one that is clicked. */
export function fill(list, levels, chosen) {
  const items = levels.map((level) => {
    const item = document.createElement("li");
    const button = document.createElement("button");
    button.type = "button";
    button.level = level;
    const name = document.createElement("span");
    name.textContent = level.name;
    button.append(picture(level), name);
    if (hasResults(level)) {
      const note = document.createElement("small");
      note.textContent = summary(level.results);
      button.append(note);
    }
    button.addEventListener("click", () => chosen(level));
    item.append(button);
    return item;
  });
  list.replaceChildren(...items);
}

/** Marks those of a list's levels that are shown. */
export function mark(list, isShown) {
  for (const button of list.querySelectorAll("button")) {
    button.setAttribute("aria-pressed", String(isShown(button.level)));
  }
}

/** What a Solver reached on a level, in a word. */
export function summary(results) {
  if (results.success !== undefined) return percent(results.success);
  return `return ${short(results.return)}`;
}

/** What a Solver reached, in full. */
export function inWords(results) {
  const known = results.success === undefined ? [] : [`${percent(results.success)} success`];
  return [...known, `return ${short(results.return)}`].join(", ");
}

/** The means of what was reached on levels, by name; null where nothing is known. */
export function means(levels) {
  const known = levels.filter(hasResults);
  if (!known.length) return null;
  return Object.fromEntries(Object.keys(known[0].results).map((name) => [
    name, known.reduce((sum, level) => sum + level.results[name], 0) / known.length,
  ]));
}

export function picture(level) {
  const image = document.createElement("img");
  image.alt = "";
  if (level.picture) image.src = `data:image/png;base64,${level.picture}`;
  return image;
}

function hasResults(level) {
  return Object.keys(level.results).length > 0;
}
