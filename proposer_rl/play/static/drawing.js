// Changing the level: by pointer, by keys, as a whole; and back again.

import { STEPS } from "./board.js";
import { Level } from "./level.js";
import { $, forget, state, tell } from "./page.js";
import { endGame, move, moveTowards, startGame } from "./playing.js";
import { show } from "./showing.js";
import { examine } from "./watching.js";

const DEEPEST = 200; // drawings that can be undone
const undone = [];
let tool; // the kind of cell that is painted
let stroke = null; // what a pointer that is down paints, and where it was

export function makeTools() {
  const { kinds } = state.about.board;
  $("tools").replaceChildren(...kinds.map((kind, index) => {
    const button = document.createElement("button");
    const swatch = document.createElement("span");
    button.type = "button";
    button.setAttribute("role", "radio");
    button.title = `Key ${index + 1}`;
    swatch.className = "swatch";
    swatch.style.background = `var(--cell-${kind.name})`;
    const alone = kinds.filter((one) => one.name === kind.name).length < 2;
    button.append(swatch, alone ? kind.name : `${kind.name} ${kind.mark}`);
    button.addEventListener("click", () => choose(kind));
    return button;
  }));
  $("tools").addEventListener("keydown", (event) => {
    const by = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    if (!by) return;
    event.preventDefault();
    choose(kinds[(kinds.indexOf(tool) + by + kinds.length) % kinds.length]);
    $("tools").querySelector("[tabindex='0']").focus();
  });
  choose(kinds[1]);
}

function choose(kind) {
  tool = kind;
  [...$("tools").children].forEach((button, index) => {
    const on = state.about.board.kinds[index] === kind;
    button.setAttribute("aria-checked", String(on));
    button.tabIndex = on ? 0 : -1;
  });
}

/** A pointer goes "down", "move"s or goes "up" at a cell. */
export function pointed(row, column, what, event) {
  const { level } = state;
  if (what === "up") {
    stroke = null;
    return;
  }
  if (what === "down" && state.playing) {
    moveTowards(row, column);
  } else if (what === "down") {
    const there = level.kind(row, column);
    const kind = there.once && there.name !== tool.name ? there : event.button === 2 ? level.kinds[0] : tool;
    // Painting over what it would paint takes it away again.
    stroke = { kind: !kind.once && kind === there ? level.kinds[0] : kind, at: [row, column] };
    remember();
  }
  if (!stroke) return;
  // A fast pointer leaves cells out: all between are painted.
  const [fromRow, fromColumn] = stroke.at;
  const count = Math.max(Math.abs(row - fromRow), Math.abs(column - fromColumn), 1);
  let next = level;
  for (let step = what === "down" ? count : 1; step <= count; step++) {
    const at = [fromRow + ((row - fromRow) * step) / count,
      fromColumn + ((column - fromColumn) * step) / count].map(Math.round);
    next = next.painted(...at, stroke.kind) ?? next;
  }
  stroke.at = [row, column];
  state.cursor = null;
  if (next !== level) set(next);
}

/** A key on the board: it draws, or plays. */
export function key(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const arrow = event.key.startsWith("Arrow") ? event.key.slice(5).toLowerCase() : "";
  const action = state.about.board.actions.indexOf(arrow);
  if (state.playing ? playKey(event.key, action) : drawKey(event.key, STEPS[arrow])) {
    event.preventDefault();
  }
}

function playKey(name, action) {
  if (action >= 0) move(action);
  else if (name === "r" || name === "R") startGame();
  else if (name === "Escape") {
    endGame();
    show();
  } else return false;
  return true;
}

function drawKey(name, step) {
  const { cursor, level } = state;
  const kind = level.kinds[Number(name) - 1];
  if (step) {
    const [down, right] = step;
    const next = cursor
      ? [cursor[0] + down, cursor[1] + right]
      : level.find(level.kinds.find((one) => one.once));
    if (level.inside(...next)) state.cursor = next;
    const [row, column] = state.cursor;
    tell(`Row ${row + 1}, column ${column + 1}: ${level.kind(row, column).name}`);
    show();
  } else if (cursor && (name === " " || name === "Enter")) {
    const next = level.painted(...cursor, level.kind(...cursor) === tool ? level.kinds[0] : tool);
    if (next) replace(next);
  } else if (kind) choose(kind);
  else return false;
  return true;
}

/** Another level, which can be undone. */
export function replace(next) {
  remember();
  set(next);
}

export function clear() {
  const { level } = state;
  replace(Level.empty(level.kinds, level.height, level.width));
}

export function resize() {
  const { level, about } = state;
  const sides = ["rows", "columns"].map((id) => {
    const side = Math.round(Number($(id).value));
    return Math.min(Math.max(side || 1, 1), about.board.largest);
  });
  if (sides[0] * sides[1] < level.marked().length) sides[1] = 2;
  replace(level.resized(...sides));
}

export function undo() {
  let before = undone.pop();
  while (before?.same(state.level)) before = undone.pop();
  set(before ?? state.level);
}

function remember() {
  if (undone.at(-1)?.same(state.level)) return;
  undone.push(state.level);
  if (undone.length > DEEPEST) undone.shift();
}

/** The level is this one from now on. */
export function set(level) {
  state.level = level;
  [$("rows").value, $("columns").value] = [level.height, level.width];
  $("undo").disabled = !undone.length;
  if (state.cursor && !level.inside(...state.cursor)) state.cursor = null;
  forget();
  state.found = state.episode = null;
  endGame();
  show();
  examine();
}
