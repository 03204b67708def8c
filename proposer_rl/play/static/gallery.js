// Levels to choose from, as pictures.

/** Fills a list with levels; chosen(level) is called with the one that is clicked. */
export function fill(list, levels, isShown, chosen) {
  const items = levels.map((level) => {
    const item = document.createElement("li");
    const button = document.createElement("button");
    button.type = "button";
    button.setAttribute("aria-pressed", String(isShown(level)));
    const name = document.createElement("span");
    name.textContent = level.name;
    button.append(picture(level), name);
    if (hasResults(level)) {
      const note = document.createElement("small");
      note.textContent = summary(level.results);
      button.append(note);
    }
    button.addEventListener("click", () => {
      for (const other of list.querySelectorAll("button")) {
        other.setAttribute("aria-pressed", String(other === button));
      }
      chosen(level);
    });
    item.append(button);
    return item;
  });
  list.replaceChildren(...items);
}

/** What a Solver reached on a level, in a word. */
export function summary(results) {
  if (results.success !== undefined) return percent(results.success);
  return `return ${results.return.toFixed(2)}`;
}

export function percent(share) {
  return `${(100 * share).toFixed(share > 0.9995 || share < 0.0005 ? 0 : 1)} %`;
}

/** The mean of what was reached, in a sentence; nothing where nothing is known. */
export function mean(levels) {
  const known = levels.filter(hasResults);
  if (!known.length) return "";
  const names = Object.keys(known[0].results);
  const means = Object.fromEntries(names.map((name) => [
    name, known.reduce((sum, level) => sum + level.results[name], 0) / known.length,
  ]));
  return `mean ${summary(means)} over ${known.length}`;
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
