// A level as rows of characters, changed without changing the one before. It knows of cells only
// what the task tells: their marks, which of them stand in a level exactly once, and that the
// first kind is the empty one.

export class Level {
  constructor(kinds, rows) {
    this.kinds = kinds;
    this.rows = rows;
  }

  /** An empty level, with what must be there in opposite corners. */
  static empty(kinds, height, width) {
    const rows = Array.from({ length: height }, () => kinds[0].mark.repeat(width));
    return new Level(kinds, rows).completed();
  }

  get height() { return this.rows.length; }
  get width() { return this.rows[0].length; }

  kind(row, column) {
    return this.kinds.find((kind) => kind.mark === this.rows[row]?.[column]);
  }

  inside(row, column) {
    return row >= 0 && column >= 0 && row < this.height && column < this.width;
  }

  /** Where a kind stands, or another of its name, for the first time; or null. */
  find(kind) {
    return this.cells().find((cell) => this.kind(...cell).name === kind.name) ?? null;
  }

  /** Where those stand that a level has once. */
  marked() {
    return this.cells().filter((cell) => this.kind(...cell).once);
  }

  cells() {
    return this.rows.flatMap((line, row) => [...line].map((_, column) => [row, column]));
  }

  /** The level with one cell of another kind; null where that cannot be. */
  painted(row, column, kind) {
    const there = this.kind(row, column);
    if (!there || there === kind || (there.once && there.name !== kind.name)) return null;
    const changed = new Level(this.kinds, this.rows);
    if (kind.once) changed.put(...this.find(kind), this.kinds[0]);
    changed.put(row, column, kind);
    return changed;
  }

  /** The level on another grid, its upper left part kept. */
  resized(height, width) {
    const blank = this.kinds[0].mark;
    const rows = Array.from({ length: height }, (_, row) =>
      (this.rows[row] ?? "").slice(0, width).padEnd(width, blank));
    return new Level(this.kinds, rows).completed();
  }

  same(other) {
    return this.rows.join("\n") === other.rows.join("\n");
  }

  put(row, column, kind) {
    this.rows = this.rows.map((line, at) =>
      at === row ? line.slice(0, column) + kind.mark + line.slice(column + 1) : line);
  }

  /** With what is missing of the kinds that must be there: from either end of the grid. */
  completed() {
    for (const kind of this.kinds.filter((one) => one.once)) {
      if (this.find(kind)) continue;
      const free = this.cells().filter((cell) => !this.kind(...cell).once);
      const place = this.marked().length ? free.at(-1) : free[0];
      if (place) this.put(...place, kind);
    }
    return this;
  }
}
