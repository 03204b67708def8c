// The page: what is asked for, and what is shown of the answers.

import { ask, latest } from "./api.js";
import { Board } from "./board.js";
import { fill, mean, percent, picture, summary } from "./gallery.js";
import { Level } from "./level.js";

const $ = (id) => document.getElementById(id);
const DEEPEST = 200; // drawings that can be undone
const calm = matchMedia("(prefers-reduced-motion: reduce)");

let about; // the run
let board; // the canvas; none of a task whose levels are only looked at
let level;
let found = null; // what the Solver of the checkpoint does on `level`
let tool;
let cursor = null; // the cell that the keys are at
let playing = null; // the cells where you have been
let episode = null; // the Solver's that is shown: its cells, and how far it is
let seed = 0; // of the levels that are drawn
let chosen = null; // the picture that is shown, where there is no board
const undone = [];
const reached = new Map(); // success on `level` by checkpoint

// ---------------------------------------------------------------- the run

async function begin() {
  about = await ask("run");
  document.title = `${about.title} · proposer_rl`;
  $("title").textContent = about.title;
  $("subtitle").textContent = about.task_title;
  setCheckpoints();
  $("solver").replaceChildren(...about.seeds.map((one, k) => new Option(one, k)));
  $("which").hidden = about.seeds.length < 2;
  setSources();
  if (about.board) setBoard();
  else $("shown").hidden = false;
  wire();
  await showLevels();
}

function setCheckpoints() {
  const slider = $("checkpoint");
  slider.max = about.checkpoints.length - 1;
  slider.value = slider.max;
  slider.disabled = $("through").disabled = about.checkpoints.length < 2;
}

function setSources() {
  const groups = [
    ["Drawn from", about.distributions.map((name) => [name, { source: "distribution", name }])],
    ["Sets", (about.board?.sets ?? []).map((name) => [name, { source: "set", name }])],
    ["Trained on", about.curriculum.map(({ updates, seed: of }, row) => [
      `update ${updates}${about.seeds.length > 1 ? `, seed ${of}` : ""}`,
      { source: "curriculum", row },
    ])],
  ];
  $("source").replaceChildren(...groups.filter(([, members]) => members.length).map(
    ([label, members]) => {
      const group = document.createElement("optgroup");
      group.label = label;
      group.append(...members.map(([name, value]) => new Option(name, JSON.stringify(value))));
      return group;
    },
  ));
}

function setBoard() {
  const { kinds, size, actions, largest, most_steps: most } = about.board;
  for (const id of ["editor", "limit", "results", "files"]) $(id).hidden = false;
  $("rows").max = $("columns").max = largest;
  $("steps").max = most;
  board = new Board($("board"), actions, pointed);
  $("tools").replaceChildren(...kinds.map((kind, index) => {
    const button = document.createElement("button");
    const swatch = document.createElement("span");
    button.type = "button";
    button.setAttribute("role", "radio");
    button.title = `Key ${index + 1}`;
    swatch.className = "swatch";
    swatch.style.background = `var(--cell-${kind.name})`;
    button.append(swatch, kind.name);
    button.addEventListener("click", () => choose(kind));
    return button;
  }));
  choose(kinds[1]);
  level = Level.empty(kinds, ...size);
  changed();
}

const checkpoint = () => about.checkpoints[Number($("checkpoint").value)];
const solver = () => Number($("solver").value);

// ---------------------------------------------------------------- drawing

function choose(kind) {
  tool = kind;
  [...$("tools").children].forEach((button, index) => {
    const on = about.board.kinds[index] === kind;
    button.setAttribute("aria-checked", String(on));
    button.tabIndex = on ? 0 : -1;
  });
}

let stroke = null; // what a pointer that is down paints, and where it was

function pointed(row, column, what, event) {
  if (what === "up") {
    stroke = null;
    return;
  }
  if (what === "down") {
    if (playing) return;
    const there = level.kind(row, column);
    const kind = there.once ? there : event.button === 2 ? level.kinds[0] : tool;
    // Painting over what it would paint takes it away again.
    stroke = { kind: !kind.once && kind === there ? level.kinds[0] : kind, at: [row, column] };
    remember();
  } else if (!stroke) return;
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
  cursor = null;
  if (next !== level) {
    level = next;
    changed();
  }
}

function remember() {
  if (undone.at(-1)?.same(level)) return;
  undone.push(level);
  if (undone.length > DEEPEST) undone.shift();
}

function replace(next) {
  remember();
  level = next;
  changed();
}

function undo() {
  let before = undone.pop();
  while (before?.same(level)) before = undone.pop();
  if (before) level = before;
  changed();
}

function resize() {
  const sides = ["rows", "columns"].map((id) => {
    const side = Math.round(Number($(id).value));
    return Math.min(Math.max(side || 1, 1), about.board.largest);
  });
  if (sides[0] * sides[1] < level.kinds.filter((kind) => kind.once).length) sides[1] = 2;
  replace(level.resized(...sides));
}

/** The level is another one. */
function changed() {
  [$("rows").value, $("columns").value] = [level.height, level.width];
  $("undo").disabled = !undone.length;
  if (cursor && !level.inside(...cursor)) cursor = null;
  reached.clear();
  found = null;
  episode = null;
  endGame();
  show();
  examine();
}

// ---------------------------------------------------------------- the Solver

const examine = latest(async () => {
  const asked = { checkpoint: checkpoint(), solver: solver(), rows: level.rows };
  const limit = Math.round(Number($("steps").value));
  try {
    const answer = await ask("examine", limit > 0 ? { ...asked, max_steps: limit } : asked);
    if (asked.rows !== level.rows) return; // drawn on meanwhile; asked again already
    found = answer;
    reached.set(asked.checkpoint, found.results.success);
    if (playing && playing.length - 1 > found.max_steps) endGame();
    trouble("");
    tell(`After ${found.updates} updates: ${percent(found.results.success)} success`);
    $("updates").textContent = place(found.updates);
  } catch (error) {
    found = null;
    tell("");
    trouble(error.message);
  }
  show();
});

const place = (updates) =>
  `${Number($("checkpoint").value) + 1} of ${about.checkpoints.length} · update ${updates}`;

/** Goes through all checkpoints from the first on, or stops doing so. */
let going = false;
async function through() {
  going = !going;
  $("through").textContent = going ? "■" : "▶";
  const slider = $("checkpoint");
  for (let step = 0; going && step <= Number(slider.max); step++) {
    slider.value = step;
    await Promise.all([moved(), new Promise((wake) => setTimeout(wake, calm.matches ? 600 : 250))]);
  }
  going = false;
  $("through").textContent = "▶";
}

/** The slider is at another checkpoint. */
async function moved() {
  episode = null;
  if (board) await examine();
  redraw();
}

/** Where the most probable moves lead, or moves that are drawn from the policy. */
function cellsOf(kind) {
  if (kind === "likely") return found.paths.solver;
  const cells = [found.paths.solver[0]];
  while (cells.length <= found.max_steps && !same(cells.at(-1), found.goal)) {
    const [row, column] = cells.at(-1);
    let left = Math.random();
    const action = found.policy[row][column].findIndex((chance) => (left -= chance) < 0);
    cells.push(after(cells.at(-1), Math.max(action, 0)));
  }
  return cells;
}

function after([row, column], action) {
  const cell = found.next[action][row * level.width + column];
  return [Math.floor(cell / level.width), cell % level.width];
}

function watch() {
  if (!found) return;
  endGame();
  const mine = { cells: cellsOf($("episode").value), at: 0 };
  episode = mine;
  const told = arrives(mine.cells)
    ? `The Solver reaches the goal in ${mine.cells.length - 1} moves.`
    : "The Solver does not reach the goal.";
  const pace = Math.max(30, Math.min(170, 6000 / mine.cells.length));
  const began = performance.now();
  const draw = (now) => {
    if (episode !== mine) return;
    const last = mine.cells.length - 1;
    mine.at = calm.matches ? last : Math.min(Math.floor(Math.max(now - began, 0) / pace), last);
    show();
    if (mine.at < last) requestAnimationFrame(draw);
    else tell(told);
  };
  requestAnimationFrame(draw);
}

const same = ([row, column], [otherRow, otherColumn]) => row === otherRow && column === otherColumn;

const arrives = (cells) => same(cells.at(-1), found.goal) && cells.length - 1 <= found.max_steps;

// ---------------------------------------------------------------- playing

function startGame() {
  if (!found) return;
  episode = null;
  playing = [found.paths.solver[0]];
  $("play").setAttribute("aria-pressed", "true");
  $("play").textContent = "Stop playing";
  $("board").classList.add("playing");
  $("board").focus();
  tell("Your turn: the arrow keys move you, R begins again.");
  show();
}

function endGame() {
  playing = null;
  $("play").setAttribute("aria-pressed", "false");
  $("play").textContent = "Play it yourself";
  $("board").classList.remove("playing");
}

const over = () => arrives(playing) || playing.length - 1 >= found.max_steps;

function move(action) {
  if (!found || over()) return;
  playing.push(after(playing.at(-1), action));
  const moves = playing.length - 1;
  const best = found.paths.shortest;
  if (arrives(playing)) {
    tell(`You reach the goal in ${moves} moves; ${best.length - 1} are the least.`);
  } else if (over()) tell(`Out of steps: ${found.max_steps} are all there are.`);
  else tell(`${moves} of ${found.max_steps} moves`);
  show();
}

function key(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const action = about.board.actions.indexOf(event.key.replace("Arrow", "").toLowerCase());
  if (playing) {
    if (action >= 0 && event.key.startsWith("Arrow")) move(action);
    else if (event.key === "r" || event.key === "R") startGame();
    else if (event.key === "Escape") {
      endGame();
      show();
    } else return;
  } else if (event.key.startsWith("Arrow")) {
    const [down, right] = board.steps[action];
    const [row, column] = cursor ?? level.find(level.kinds.find((kind) => kind.once));
    const next = cursor ? [row + down, column + right] : [row, column];
    if (level.inside(...next)) cursor = next;
    tell(`Row ${cursor[0] + 1}, column ${cursor[1] + 1}: ${level.kind(...cursor).name}`);
    show();
  } else if (cursor && (event.key === " " || event.key === "Enter")) {
    const kind = level.kind(...cursor) === tool ? level.kinds[0] : tool;
    const next = level.painted(...cursor, kind);
    if (next) replace(next);
  } else if (about.board.kinds[Number(event.key) - 1]) {
    choose(about.board.kinds[Number(event.key) - 1]);
  } else return;
  event.preventDefault();
}

// ---------------------------------------------------------------- what is shown

function show() {
  if (!board) return;
  const lines = [];
  const agents = [];
  if (found && $("shortest").checked && found.paths.shortest) {
    lines.push({ cells: found.paths.shortest, colour: "best", dashed: true });
  }
  if (episode) {
    const cells = episode.cells.slice(0, episode.at + 1);
    lines.push({ cells, colour: "solver" });
    agents.push({ cell: cells.at(-1), colour: "solver" });
  } else if (found && $("route").checked && !playing) {
    lines.push({ cells: found.paths.solver, colour: "solver" });
  }
  if (playing) {
    lines.push({ cells: playing, colour: "you" });
    agents.push({ cell: playing.at(-1), colour: "you" });
  }
  const map = found && $("heat").value in found.maps ? colouring($("heat").value) : null;
  board.show({
    level, lines, agents, map, cursor: document.activeElement === $("board") ? cursor : null,
    policy: found && $("arrows").checked ? found.policy : null,
  });
  $("scale").hidden = !map;
  if (map) [$("scale-low").textContent, $("scale-high").textContent] = map.range.map(short);
  for (const id of ["watch", "play"]) $(id).disabled = !found;
  if (found) nameMaps();
  showResults();
  showAlong();
}

function colouring(name) {
  const values = found.maps[name];
  const known = values.flat().filter((value) => value !== null);
  const shares = name.includes("success");
  return { values, range: shares ? [0, 1] : [Math.min(...known), Math.max(...known)] };
}

function nameMaps() {
  const select = $("heat");
  if (select.options.length > 1) return;
  select.append(...Object.keys(found.maps).map((name) => new Option(name, name)));
}

function showResults() {
  const body = $("results").tBodies[0];
  if (!found) {
    body.replaceChildren();
    return;
  }
  const { results, paths, max_steps: limit, step_penalty: cost } = found;
  const moves = (cells) => {
    const there = cells && arrives(cells);
    const count = there ? cells.length - 1 : limit;
    return [there ? "yes" : "no", there ? count : "–", short((there ? 1 : 0) - cost * count)];
  };
  const rows = [
    ["Solver, sampled", "", percent(results.success), short(results.steps), short(results.return)],
    ["Solver, most probable", "solver", ...moves(paths.solver)],
    ["Shortest path", "best", ...moves(paths.shortest)],
  ];
  if (playing) {
    rows.push(["You", "you", ...(over() ? moves(playing) : ["…", playing.length - 1, "…"])]);
  }
  body.replaceChildren(...rows.map(([name, colour, ...cells]) => {
    const row = document.createElement("tr");
    const head = document.createElement("th");
    head.scope = "row";
    const mark = document.createElement("span");
    mark.className = `key ${colour}`;
    head.append(mark, name);
    row.append(head, ...cells.map((text) => {
      const cell = document.createElement("td");
      cell.textContent = text;
      return cell;
    }));
    return row;
  }));
  $("steps").placeholder = limit;
}

/** Success on this level at the checkpoints that were looked at. */
function showAlong() {
  $("along").hidden = $("along-label").hidden = about.checkpoints.length < 2;
  $("along").replaceChildren(...about.checkpoints.map((step) => {
    const bar = document.createElement("span");
    const success = reached.get(step);
    bar.className = success === undefined ? "unknown" : step === checkpoint() ? "now" : "";
    bar.style.height = `${100 * (success ?? 0)}%`;
    return bar;
  }));
}

const short = (value) =>
  String(Number(value.toFixed(Math.abs(value) < 10 ? 3 : 1))).replace("-", "−");

const tell = (text) => { $("status").textContent = text; };

function trouble(text) {
  $("trouble").textContent = text;
  $("trouble").hidden = !text;
}

// ---------------------------------------------------------------- levels to choose from

const showLevels = latest(async () => {
  const source = JSON.parse($("source").value);
  const drawn = source.source === "distribution";
  $("draw").hidden = !drawn;
  const question = drawn ? { ...source, seed, checkpoint: checkpoint(), solver: solver() } : source;
  try {
    offer(await ask("levels", question));
    trouble("");
  } catch (error) {
    trouble(error.message);
  }
});

function offer({ levels, updates }) {
  const isShown = (one) => (board ? one.rows.join() === level.rows.join() : one.name === chosen);
  fill($("gallery"), levels, isShown, take);
  const after = updates === undefined ? "" : `update ${updates}`;
  $("found").textContent = [after, mean(levels)].filter(Boolean).join(": ");
  if (board) return;
  $("updates").textContent = place(updates);
  if (levels.length) display(levels.find((one) => one.name === chosen) ?? levels[0]);
}

function take(one) {
  if (!one.rows) {
    display(one);
    return;
  }
  $("name").value = one.name;
  replace(new Level(about.board.kinds, one.rows));
}

function display(one) {
  chosen = one.name;
  $("picture").src = picture(one).src;
  const results = Object.keys(one.results).length ? [summary(one.results)] : [];
  $("caption").textContent = [one.name, ...one.text, ...results].join(" · ");
  $("picture").alt = $("caption").textContent;
  tell(results.length ? `${one.name}: ${results[0]}` : "");
}

/** Draws of a distribution again, when the slider has come to rest. */
let resting;
function redraw() {
  clearTimeout(resting);
  if (JSON.parse($("source").value).source !== "distribution") return;
  resting = setTimeout(showLevels, 300);
}

async function save(event) {
  event.preventDefault();
  const name = $("name").value.trim();
  try {
    const { text } = await ask("file", { name, rows: level.rows });
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([text], { type: "text/plain" }));
    link.download = `${name.replace(/[^\w-]+/g, "_")}.txt`;
    link.click();
    URL.revokeObjectURL(link.href);
    trouble("");
  } catch (error) {
    trouble(error.message);
  }
}

async function open() {
  const [file] = $("file").files;
  if (!file) return;
  try {
    offer(await ask("levels", { source: "file", text: await file.text() }));
    trouble("");
  } catch (error) {
    trouble(`${file.name}: ${error.message}`);
  }
  $("file").value = "";
}

function wire() {
  const listeners = {
    checkpoint: ["input", moved],
    through: ["click", through],
    solver: ["change", moved],
    steps: ["change", () => { endGame(); examine(); }],
    source: ["change", () => { chosen = null; showLevels(); }],
    draw: ["click", () => { seed += 1; chosen = null; showLevels(); }],
    watch: ["click", watch],
    play: ["click", () => { if (playing) { endGame(); show(); } else startGame(); }],
    rows: ["change", resize],
    columns: ["change", resize],
    undo: ["click", undo],
    clear: ["click", () => replace(Level.empty(level.kinds, level.height, level.width))],
    files: ["submit", save],
    file: ["change", open],
    board: ["keydown", key],
  };
  for (const [id, [event, listener]] of Object.entries(listeners)) {
    $(id).addEventListener(event, listener);
  }
  for (const id of ["arrows", "route", "shortest", "heat"]) $(id).addEventListener("change", show);
  for (const event of ["focus", "blur"]) $("board").addEventListener(event, show);
  document.addEventListener("keydown", (event) => {
    if (board && (event.ctrlKey || event.metaKey) && event.key === "z"
      && event.target.type !== "text") {
      event.preventDefault();
      undo();
    }
  });
  $("tools").addEventListener("keydown", (event) => {
    const by = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    if (!by) return;
    event.preventDefault();
    const { kinds } = about.board;
    choose(kinds[(kinds.indexOf(tool) + by + kinds.length) % kinds.length]);
    $("tools").querySelector("[tabindex='0']").focus();
  });
}

begin().catch((error) => {
  $("title").textContent = "bin/play";
  trouble(error.message);
});
