// The page of a run.

import { ask } from "./api.js";
import { Board } from "./board.js";
import { clear, key, makeTools, pointed, resize, set, undo } from "./drawing.js";
import { Level } from "./level.js";
import { open, save, setSources, showLevels, showOthers } from "./levels.js";
import { $, forget, state, trouble } from "./page.js";
import { endGame, startGame } from "./playing.js";
import { show } from "./showing.js";
import { moved, renew, setCheckpoints, through } from "./slider.js";
import { examine, watch } from "./watching.js";

async function begin() {
  const about = await ask("run");
  state.about = about;
  document.title = `${about.title} · proposer_rl`;
  $("title").textContent = about.title;
  $("subtitle").textContent = about.task_title;
  $("solver").replaceChildren(...about.seeds.map((seed, solver) => new Option(seed, solver)));
  $("which").hidden = about.seeds.length < 2;
  setCheckpoints();
  setSources();
  if (about.board) setBoard(about.board);
  else $("shown").hidden = false;
  wire();
  await showLevels();
}

function setBoard({ kinds, size, actions, largest, most_steps: most }) {
  for (const id of ["editor", "help", "limit", "results", "files"]) $(id).hidden = false;
  $("rows").max = $("columns").max = largest;
  $("steps").max = most;
  state.board = new Board($("board"), actions, pointed);
  makeTools();
  set(Level.empty(kinds, ...size.map((side) => Math.min(side, largest))));
}

function wire() {
  const listeners = {
    checkpoint: ["input", moved],
    through: ["click", through],
    solver: ["change", () => { forget(); moved(); }],
    steps: ["change", () => { forget(); endGame(); examine(); }],
    source: ["change", () => showOthers(false)],
    draw: ["click", () => showOthers(true)],
    watch: ["click", watch],
    play: ["click", () => { if (state.playing) { endGame(); show(); } else startGame(); }],
    rows: ["change", resize],
    columns: ["change", resize],
    undo: ["click", undo],
    clear: ["click", clear],
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
    const typing = event.target.type === "text";
    if (state.board && (event.ctrlKey || event.metaKey) && event.key === "z" && !typing) {
      event.preventDefault();
      undo();
    }
  });
  // What failed may have failed because a checkpoint is gone.
  const look = () => renew().then(() => trouble("run", ""), (error) => error);
  window.addEventListener("focus", look);
  document.addEventListener("trouble", look);
}

begin().catch((error) => {
  $("title").textContent = "bin/play";
  trouble("run", error.message);
});
