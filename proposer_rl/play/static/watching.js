// What the Solver of the checkpoint does on the level, and one episode of it in pictures.

import { ask, latest } from "./api.js";
import { $, calm, checkpoint, percent, solver, state, tell, tellPlace, trouble } from "./page.js";
import { endGame } from "./playing.js";
import { arrives, sampled } from "./rules.js";
import { show } from "./showing.js";

const SLOWEST = 170; // milliseconds for a move
const FASTEST = 30;
const WHOLE = 6000; // for an episode that is neither

/** Asks for it. */
export const examine = latest(async () => {
  const { epoch, level } = state;
  const limit = Math.round(Number($("steps").value));
  const question = {
    checkpoint: checkpoint(),
    solver: solver(),
    rows: level.rows,
    max_steps: limit > 0 ? limit : null,
  };
  try {
    const found = await ask("examine", question);
    if (epoch !== state.epoch) return; // it is asked for again already
    state.found = found;
    state.reached.set(question.checkpoint, found.results.success);
    trouble("examine", "");
    tell(`After ${found.updates} updates: ${percent(found.results.success)} success`);
    tellPlace(found.updates);
  } catch (error) {
    state.found = null;
    endGame();
    tell("");
    trouble("examine", error.message);
  }
  show();
});

/** Shows an episode of the kind that is chosen, move by move. */
export function watch() {
  if (!state.found) return;
  endGame();
  const greedy = $("episode").value === "greedy";
  const cells = greedy ? state.found.paths.solver : sampled();
  const mine = { cells, at: 0 };
  const told = arrives(cells)
    ? `The Solver reaches the goal in ${cells.length - 1} moves.`
    : "The Solver does not reach the goal.";
  const pace = Math.max(FASTEST, Math.min(SLOWEST, WHOLE / cells.length));
  const began = performance.now();
  const draw = (now) => {
    if (state.episode !== mine) return;
    const last = cells.length - 1;
    mine.at = calm.matches ? last : Math.min(Math.floor(Math.max(now - began, 0) / pace), last);
    show();
    if (mine.at < last) requestAnimationFrame(draw);
    else tell(told);
  };
  state.episode = mine;
  requestAnimationFrame(draw);
}
