// Your own episode.

import { $, state, tell } from "./page.js";
import { after, arrives, over, ways } from "./rules.js";
import { show } from "./showing.js";

export function startGame() {
  if (!state.found) return;
  state.episode = null;
  state.playing = [state.found.paths.solver[0]];
  showButton(true);
  $("board").focus();
  tell(ways() > 1 ? "Your turn: the arrows turn you left and right, up moves you forward. R begins again."
    : "Your turn: the arrow keys move you, or a touch beside you. R begins again.");
  show();
}

/** Ends it; whoever calls this shows what is there now. */
export function endGame() {
  state.playing = null;
  showButton(false);
}

export function move(action) {
  const { found, playing } = state;
  if (!found || over(playing)) return;
  playing.push(after(playing.at(-1), action));
  const moves = playing.length - 1;
  if (arrives(playing)) {
    const least = found.paths.shortest.length - 1;
    tell(`You reach the goal in ${moves} moves; ${least} are the least.`);
  } else if (over(playing)) tell(`Out of steps: ${found.max_steps} are all there are.`);
  else tell(`${moves} of ${found.max_steps} moves`);
  show();
}

/** The move that leads most towards a cell that was touched. */
export function moveTowards(row, column) {
  if (ways() > 1) return; // an agent that turns is led by keys
  const { steps } = state.board;
  const [fromRow, fromColumn] = state.playing.at(-1);
  const along = ([down, right]) => down * (row - fromRow) + right * (column - fromColumn);
  const best = steps.reduce((one, other) => (along(other) > along(one) ? other : one));
  if (along(best) > 0) move(steps.indexOf(best));
}

function showButton(on) {
  $("play").setAttribute("aria-pressed", String(on));
  $("play").textContent = on ? "Stop playing" : "Play it yourself";
  $("board").classList.toggle("playing", on);
}
