// The run's checkpoints.

import { ask } from "./api.js";
import { areDrawn, setSources, showLevels } from "./levels.js";
import { $, calm, checkpoint, state } from "./page.js";
import { examine } from "./watching.js";

const RESTS = 300; // milliseconds after which the slider has come to rest

let going = false;
let resting;

export function setCheckpoints() {
  const slider = $("checkpoint");
  slider.max = state.about.checkpoints.length - 1;
  slider.value = slider.max;
  slider.disabled = $("through").disabled = state.about.checkpoints.length < 2;
}

/** It is at another one: draws of a distribution follow when it has come to rest. */
export async function moved() {
  state.episode = null;
  if (!state.board) return showLevels();
  await examine();
  clearTimeout(resting);
  if (areDrawn()) resting = setTimeout(showLevels, RESTS);
}

/** Goes through all of them from the first on, or stops doing so. */
export async function through() {
  going = !going;
  const slider = $("checkpoint");
  const pause = () => new Promise((wake) => setTimeout(wake, calm.matches ? 600 : 250));
  $("through").textContent = going ? "■" : "▶";
  for (let step = 0; going && step <= Number(slider.max); step++) {
    slider.value = step;
    await Promise.all([moved(), pause()]);
  }
  going = false;
  $("through").textContent = "▶";
}

/** A run that goes on has others after a while: those that are gone cannot be chosen. */
export async function renew() {
  const { checkpoints, curriculum } = await ask("run");
  const before = checkpoint();
  if (checkpoints.join() === state.about.checkpoints.join()) return;
  Object.assign(state.about, { checkpoints, curriculum });
  setCheckpoints();
  setSources();
  if (checkpoints.includes(before)) $("checkpoint").value = checkpoints.indexOf(before);
  moved();
}
