// The canvas: a level, what is shown of a Solver on it, and where the pointer is.

export const STEPS = { up: [-1, 0], down: [1, 0], left: [0, -1], right: [0, 1] };
const WAYS = [STEPS.right, STEPS.down, STEPS.left, STEPS.up]; // in which an agent looks
const LEAST = 0.03; // an action less probable than this has no arrow
const LETTERS = 16; // pixels of a cell from which on it has room for a letter

export class Board {
  /** The canvas to draw on; called with row, column and "down", "move" or "up" of a pointer. */
  constructor(canvas, actions, pointed) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.steps = actions.map((action) => STEPS[action]);
    this.scene = null;
    this.colours = readColours();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
      this.colours = readColours();
      this.draw();
    });
    new ResizeObserver(() => this.draw()).observe(canvas.parentElement);
    const tell = (event, what) => {
      const cell = this.cellAt(event);
      if (cell) pointed(...cell, what, event);
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      tell(event, "down");
    });
    canvas.addEventListener("pointermove", (event) => tell(event, "move"));
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => pointed(0, 0, "up", event));
    }
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  /**
   * Draws from now on: level, policy [H][W][A] or null, map [H][W] or null with its range, lines
   * [{cells, colour, dashed}], agents [{cell, colour}], cursor.
   */
  show(scene) {
    this.scene = scene;
    this.draw();
  }

  cellAt(event) {
    const { level } = this.scene;
    const box = this.canvas.getBoundingClientRect();
    const row = Math.floor(((event.clientY - box.top) / box.height) * level.height);
    const column = Math.floor(((event.clientX - box.left) / box.width) * level.width);
    return level.inside(row, column) ? [row, column] : null;
  }

  draw() {
    if (!this.scene) return;
    const { level, cursor } = this.scene;
    const room = this.canvas.parentElement.clientWidth;
    const tall = Math.min(room, Math.max(innerHeight * 0.6, 280));
    this.cell = Math.max(4, Math.floor(Math.min(room / level.width, tall / level.height, 96)));
    const ratio = devicePixelRatio || 1;
    const [height, width] = [level.height * this.cell, level.width * this.cell];
    Object.assign(this.canvas.style, { width: `${width}px`, height: `${height}px` });
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.drawCells();
    this.drawLines();
    this.drawPolicy();
    this.drawMarks();
    for (const agent of this.scene.agents) this.drawAgent(agent);
    if (cursor) this.outline(cursor);
  }

  drawCells() {
    const { level, map } = this.scene;
    const { context, cell, colours } = this;
    for (let row = 0; row < level.height; row++) {
      for (let column = 0; column < level.width; column++) {
        context.fillStyle = colours[level.kind(row, column).name] ?? colours.free;
        if (level.kind(row, column).once) context.fillStyle = colours.free;
        context.fillRect(column * cell, row * cell, cell, cell);
        const value = map?.values[row][column];
        if (value != null) {
          context.globalAlpha = 0.08 + 0.77 * share(value, map.range);
          context.fillStyle = colours.heat;
          context.fillRect(column * cell, row * cell, cell, cell);
          context.globalAlpha = 1;
        }
      }
    }
    context.strokeStyle = colours.line;
    context.lineWidth = 1;
    context.beginPath();
    for (let row = 0; row <= level.height; row++) {
      context.moveTo(0, row * cell);
      context.lineTo(level.width * cell, row * cell);
    }
    for (let column = 0; column <= level.width; column++) {
      context.moveTo(column * cell, 0);
      context.lineTo(column * cell, level.height * cell);
    }
    context.stroke();
  }

  drawPolicy() {
    const { policy, level } = this.scene;
    if (!policy) return;
    this.context.fillStyle = this.context.strokeStyle = this.colours.ink;
    this.context.lineCap = "round";
    policy.forEach((line, row) => line.forEach((chances, column) => {
      if (!chances) return;
      const most = Math.max(...chances);
      chances.forEach((chance, action) => {
        // In small cells only what is most probable can be seen.
        if (chance < LEAST || (this.cell < LETTERS && chance < most)) return;
        this.arrow(row, column, this.steps[action], chance, level.kind(row, column).once);
      });
    }));
    this.context.globalAlpha = 1;
  }

  arrow(row, column, [down, right], chance, marked) {
    const { context, cell } = this;
    const from = cell * (marked ? 0.3 : 0.06);
    const to = cell * (marked ? 0.34 + 0.12 * chance : 0.14 + 0.3 * chance);
    const head = cell * (0.05 + 0.07 * chance);
    const x = (column + 0.5) * cell;
    const y = (row + 0.5) * cell;
    context.globalAlpha = 0.25 + 0.75 * chance;
    context.lineWidth = Math.max(1, cell * 0.05);
    context.beginPath();
    context.moveTo(x + right * from, y + down * from);
    context.lineTo(x + right * (to - head), y + down * (to - head));
    context.stroke();
    context.beginPath();
    context.moveTo(x + right * to, y + down * to);
    for (const side of [1, -1]) {
      context.lineTo(
        x + right * (to - 1.6 * head) + down * side * head,
        y + down * (to - 1.6 * head) + right * side * head,
      );
    }
    context.fill();
  }

  drawMarks() {
    const { level } = this.scene;
    const { context, cell, colours } = this;
    for (const [row, column] of level.marked()) {
      const kind = level.kind(row, column);
      context.fillStyle = colours[kind.name];
      context.beginPath();
      context.roundRect((column + 0.2) * cell, (row + 0.2) * cell, cell * 0.6, cell * 0.6, cell * 0.12);
      context.fill();
      if (cell < LETTERS) continue;
      context.fillStyle = colours.mark;
      context.font = `600 ${Math.round(cell * 0.36)}px system-ui, sans-serif`;
      context.textAlign = "center";
      context.textBaseline = "middle";
      context.fillText(kind.mark, (column + 0.5) * cell, (row + 0.52) * cell);
    }
  }

  drawLines() {
    const { context, cell } = this;
    context.lineJoin = context.lineCap = "round";
    this.scene.lines.forEach(({ cells, colour, dashed }, index) => {
      // Beside each other, so that none hides another.
      const shift = (index - (this.scene.lines.length - 1) / 2) * Math.max(2, cell * 0.1);
      context.strokeStyle = this.colours[colour];
      context.lineWidth = Math.max(2, cell * 0.08);
      context.setLineDash(dashed ? [cell * 0.16, cell * 0.18] : []);
      context.beginPath();
      for (const [row, column] of cells) {
        context.lineTo((column + 0.5) * cell + shift, (row + 0.5) * cell + shift);
      }
      context.stroke();
    });
    context.setLineDash([]);
  }

  drawAgent({ cell: [row, column, way], colour }) {
    const { context, cell } = this;
    context.beginPath();
    context.arc((column + 0.5) * cell, (row + 0.5) * cell, cell * 0.26, 0, 2 * Math.PI);
    context.fillStyle = this.colours[colour];
    context.strokeStyle = this.colours.free;
    context.lineWidth = Math.max(1.5, cell * 0.05);
    context.fill();
    context.stroke();
    if (way === undefined) return;
    const [down, right] = WAYS[way];
    context.beginPath();
    context.moveTo((column + 0.5) * cell, (row + 0.5) * cell);
    context.lineTo((column + 0.5 + right * 0.24) * cell, (row + 0.5 + down * 0.24) * cell);
    context.stroke();
  }

  outline([row, column]) {
    const { context, cell } = this;
    context.strokeStyle = this.colours.cursor;
    context.lineWidth = 3;
    context.strokeRect(column * cell + 2, row * cell + 2, cell - 4, cell - 4);
  }
}

/** Where a number lies in a range, 0 to 1. */
export function share(value, [low, high]) {
  return high > low ? (value - low) / (high - low) : 0.5;
}

function readColours() {
  const style = getComputedStyle(document.documentElement);
  const names = ["free", "wall", "start", "goal", "line", "ink", "mark", "heat", "cursor",
    "solver", "best", "you"];
  return Object.fromEntries(
    names.map((name) => [name, style.getPropertyValue(`--cell-${name}`).trim()]),
  );
}
