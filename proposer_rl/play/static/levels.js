// Levels to choose from: drawn from distributions, of sets, of the run, of files; and saving one.

import { ask, latest } from "./api.js";
import { replace } from "./drawing.js";
import { fill, inWords, means, picture } from "./gallery.js";
import { Level } from "./level.js";
import { $, checkpoint, forget, solver, state, tellPlace, trouble } from "./page.js";
import { show } from "./showing.js";

let seed = 0; // of the levels that are drawn

export function setSources() {
  const { about } = state;
  const groups = [
    ["Drawn from", about.distributions.map((name) => [name, { source: "distribution", name }])],
    ["Sets", (about.board?.sets ?? []).map((name) => [name, { source: "set", name }])],
    ["Trained on", about.curriculum.map(({ updates, seed: of }, row) => [
      `update ${updates}${about.seeds.length > 1 ? `, seed ${of}` : ""}`,
      { source: "curriculum", row },
    ])],
  ];
  const before = $("source").value;
  $("source").replaceChildren(...groups.filter(([, members]) => members.length).map(
    ([label, members]) => {
      const group = document.createElement("optgroup");
      group.label = label;
      group.append(...members.map(([name, value]) => new Option(name, JSON.stringify(value))));
      return group;
    },
  ));
  if (before) $("source").value = before;
}

const source = () => JSON.parse($("source").value);
export const areDrawn = () => source().source === "distribution";

export const showLevels = latest(async () => {
  const { epoch, board } = state;
  const drawn = areDrawn();
  const at = drawn ? { seed, checkpoint: checkpoint(), solver: solver() } : {};
  $("draw").hidden = !drawn;
  try {
    const answer = await ask("levels", { ...source(), ...at });
    trouble("levels", "");
    if (!board && epoch !== state.epoch) return; // they are asked for again already
    if (!board && drawn) {
      const success = means(answer.levels)?.success;
      if (success !== undefined) state.reached.set(at.checkpoint, success);
      tellPlace(answer.updates);
    }
    offer(answer);
  } catch (error) {
    trouble("levels", error.message);
  }
});

/** Others than before: another source, or another draw of it. */
export function showOthers(drawn) {
  if (drawn) seed += 1;
  state.chosen = null;
  if (!state.board) forget();
  return showLevels();
}

function offer({ levels, updates }) {
  fill($("gallery"), levels, take);
  const after = updates === undefined ? "" : `After ${updates} updates`;
  const mean = means(levels);
  const reached = mean && `mean of ${levels.length} levels: ${inWords(mean)}`;
  $("found").textContent = [after, reached].filter(Boolean).join(", ");
  const { board, chosen } = state;
  if (!board && levels.length) display(levels.find((one) => one.name === chosen) ?? levels[0]);
  else show();
}

function take(one) {
  if (!one.rows) {
    display(one);
    return;
  }
  $("name").value = one.name;
  replace(new Level(state.about.board.kinds, one.rows));
}

/** Shows a level that cannot be drawn. */
function display(one) {
  const results = Object.keys(one.results).length ? [inWords(one.results)] : [];
  state.chosen = one.name;
  $("picture").src = picture(one).src;
  $("picture").alt = [one.name, ...one.text].join(", ");
  $("caption").textContent = [one.name, ...results].join(": ");
  $("lines").textContent = one.text.join("\n");
  show();
}

export async function save(event) {
  event.preventDefault();
  const name = $("name").value.trim();
  try {
    const { text } = await ask("file", { name, rows: state.level.rows });
    const link = document.createElement("a");
    // Not the URL of a blob: a busy browser fetches it after it was revoked, and saves nothing.
    link.href = `data:text/plain;charset=utf-8,${encodeURIComponent(text)}`;
    link.download = `${name.replace(/[^\w-]+/g, "_")}.txt`;
    link.click();
    trouble("file", "");
  } catch (error) {
    trouble("file", error.message);
  }
}

export async function open() {
  const [file] = $("file").files;
  if (!file) return;
  try {
    offer(await ask("levels", { source: "file", text: await file.text() }));
    trouble("file", "");
  } catch (error) {
    trouble("file", `${file.name}: ${error.message}`);
  }
  $("file").value = "";
}
