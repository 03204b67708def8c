// Where moves lead, as the task has told of the level: the page knows no rules of its own.

import { state } from "./page.js";

const same = ([row, column], [otherRow, otherColumn]) => row === otherRow && column === otherColumn;

/** How many places a cell has: one, or one for each direction in which an agent looks. */
export const ways = () => state.found.next[0].length / (state.level.width * state.level.height);

/** The place that an action leads to. */
export function after([row, column, way = 0], action) {
  const { width } = state.level;
  const there = state.found.next[action][(row * width + column) * ways() + way];
  const cell = Math.floor(there / ways());
  return [Math.floor(cell / width), cell % width, ...(ways() > 1 ? [there % ways()] : [])];
}

/** Whether a way ends at the goal within the step limit. */
export const arrives = (cells) =>
  same(cells.at(-1), state.found.goal) && cells.length - 1 <= state.found.max_steps;

/** Whether an episode has come to its end. */
export const over = (cells) => arrives(cells) || cells.length - 1 >= state.found.max_steps;

/** An episode whose moves are drawn from the policy, or one of those that were played. */
export function sampled() {
  const { sampled: played } = state.found.paths;
  if (played) return played[Math.floor(Math.random() * played.length)];
  const cells = [state.found.paths.solver[0]];
  while (!over(cells)) {
    const [row, column] = cells.at(-1);
    let left = Math.random();
    const action = state.found.policy[row][column].findIndex((chance) => (left -= chance) < 0);
    cells.push(after(cells.at(-1), Math.max(action, 0)));
  }
  return cells;
}
