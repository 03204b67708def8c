// Everything that is seen of the state: the board, the table, the bars along training.

import { mark } from "./gallery.js";
import { $, checkpoint, percent, short, state } from "./page.js";
import { arrives, over } from "./rules.js";

/** Draws all of it anew. */
export function show() {
  showChosen();
  showAlong();
  if (!state.board) return;
  const { found, level } = state;
  const map = found && $("heat").value in found.maps ? colouring($("heat").value) : null;
  state.board.show({
    level,
    map,
    ...moving(),
    policy: found && $("arrows").checked ? found.policy : null,
    cursor: document.activeElement === $("board") ? state.cursor : null,
  });
  $("scale").hidden = !map;
  if (map) {
    const ends = map.range.map((value) => short(Number(value.toPrecision(2))));
    [$("scale-low").textContent, $("scale-high").textContent] = ends;
  }
  for (const id of ["watch", "play"]) $(id).disabled = !found;
  if (found) {
    nameMaps();
    $("policy").hidden = !found.policy;
    $("colour").hidden = !Object.keys(found.maps).length;
  }
  showResults();
}

/** Ways as lines, and who is on them. */
function moving() {
  const { found, episode, playing } = state;
  const lines = [];
  const agents = [];
  if (found && $("shortest").checked && found.paths.shortest) {
    lines.push({ cells: found.paths.shortest, colour: "best", dashed: true });
  }
  if (episode) {
    const cells = episode.cells.slice(0, episode.at + 1);
    lines.push({ cells, colour: "solver" });
    agents.push({ cell: cells.at(-1), colour: "solver" });
  } else if (found && $("route").checked && (!playing || over(playing))) {
    lines.push({ cells: found.paths.solver, colour: "solver" });
  }
  if (playing) {
    lines.push({ cells: playing, colour: "you" });
    agents.push({ cell: playing.at(-1), colour: "you" });
  }
  return { lines, agents };
}

function colouring(name) {
  const values = state.found.maps[name];
  const known = values.flat().filter((value) => value !== null);
  const shares = name.includes("success");
  return { values, range: shares ? [0, 1] : [Math.min(...known), Math.max(...known)] };
}

function nameMaps() {
  const select = $("heat");
  if (select.options.length > 1) return;
  select.append(...Object.keys(state.found.maps).map((name) => new Option(name, name)));
}

function showResults() {
  const { found, playing } = state;
  const body = $("results").tBodies[0];
  if (!found) {
    // The rows stay, so that what lies below does not move under the mouse at each stroke.
    for (const cell of body.querySelectorAll("td")) cell.textContent = "…";
    return;
  }
  const { results, paths, max_steps: limit, step_penalty: cost, missed } = found;
  const way = (cells) => {
    const there = cells && arrives(cells);
    const count = there ? cells.length - 1 : limit;
    return [there ? "yes" : "no", there ? count : "–", short(there ? 1 - cost * count : missed)];
  };
  const rows = [
    [`Solver, ${found.episodes ? `${found.episodes} episodes` : "sampled"}`, "", percent(results.success), short(results.steps), short(results.return)],
    ["Solver, greedy", "solver", ...way(paths.solver)],
    ["Shortest path", "best", ...way(paths.shortest)],
  ];
  if (playing) {
    rows.push(["You", "you", ...(over(playing) ? way(playing) : ["…", playing.length - 1, "…"])]);
  }
  body.replaceChildren(...rows.map(([name, colour, ...cells]) => tableRow(name, colour, cells)));
  $("steps").placeholder = limit;
}

function tableRow(name, colour, cells) {
  const row = document.createElement("tr");
  const head = document.createElement("th");
  const key = document.createElement("span");
  head.scope = "row";
  key.className = `key ${colour}`;
  head.append(key, name);
  row.append(head, ...cells.map((text) => {
    const cell = document.createElement("td");
    cell.textContent = text;
    return cell;
  }));
  return row;
}

/** Success at the checkpoints that were looked at. */
function showAlong() {
  const { about, board, reached } = state;
  const nothing = about.checkpoints.length < 2 || (!board && !reached.size);
  $("along").hidden = $("along-label").hidden = nothing;
  $("along").replaceChildren(...about.checkpoints.map((step) => {
    const bar = document.createElement("span");
    const success = reached.get(step);
    bar.className = success === undefined ? "unknown" : step === checkpoint() ? "now" : "";
    bar.style.height = `${100 * (success ?? 0)}%`;
    return bar;
  }));
}

/** Which of the levels on offer is the one that is shown. */
function showChosen() {
  const { board, level, chosen } = state;
  mark($("gallery"), (one) =>
    board && one.rows ? one.rows.join() === level.rows.join() : one.name === chosen);
}
