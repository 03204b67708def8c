// What all parts of the page share: its elements, its state, and what is said in words.

export const $ = (id) => document.getElementById(id);
export const calm = matchMedia("(prefers-reduced-motion: reduce)");

export const state = {
  about: null, // the run
  board: null, // the canvas; none of a task whose levels are only looked at
  level: null,
  found: null, // what the Solver of the checkpoint does on the level
  playing: null, // the cells where you have been
  episode: null, // the Solver's that is shown: its cells, and how far it is
  cursor: null, // the cell that the keys are at
  chosen: null, // the name of the picture that is shown, where there is no board
  epoch: 0, // grows when what was asked before is of no use any more
  reached: new Map(), // success by checkpoint: on the level, or on the levels that are drawn
};

export const checkpoint = () => state.about.checkpoints[Number($("checkpoint").value)];
export const solver = () => Number($("solver").value);

/** What was reached was reached on something else, or under other rules. */
export function forget() {
  state.epoch += 1;
  state.reached.clear();
}

/** Says how it stands, to whoever listens as well. */
export function tell(text) {
  $("status").textContent = text;
}

const troubles = new Map();

/** Says what went wrong with something, until it goes well again: an empty text. */
export function trouble(what, text) {
  if (text) troubles.set(what, text);
  else troubles.delete(what);
  $("trouble").textContent = [...troubles.values()].join(" ");
  $("trouble").hidden = !troubles.size;
  if (text) document.dispatchEvent(new Event("trouble"));
}

/** Where the slider is. */
export function tellPlace(updates) {
  const number = Number($("checkpoint").value) + 1;
  $("updates").textContent = `${number} of ${state.about.checkpoints.length} · update ${updates}`;
}

export const short = (value) =>
  String(Number(value.toFixed(Math.abs(value) < 10 ? 3 : 1))).replace("-", "−");

export const percent = (share) =>
  `${(100 * share).toFixed(share > 0.9995 || share < 0.0005 ? 0 : 1)} %`;
