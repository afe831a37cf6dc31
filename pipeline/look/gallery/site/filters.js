// Which levels are chosen, and in which order. Knows columns, and nothing of presentation.
"use strict";

(function () {
  const BINS = 36; // bins of a histogram

  // Conditions on columns: a set of words, or a range of numbers. A row fails `failures[row]` conditions and is chosen
  // if that is 0. A histogram counts the rows that fail at most its own condition.
  class Choice {
    constructor(columns) {
      this.columns = columns;
      this.conditions = new Map(); // column: Set of word indices, or [low, high], infinite where there is no limit
      this.fails = new Map(); // column: 1 for each row that fails its condition, else 0
      this.failures = new Uint8Array(columns.about.levels);
      this.sortedBy = ["level_id", 1]; // column, and 1 ascending or -1 descending
      this.order = null;
    }

    // Set a column's condition; null removes it.
    set(name, condition) {
      if (condition) this.conditions.set(name, condition);
      else this.conditions.delete(name);
      this._judge(name);
    }

    clear() {
      for (const name of [...this.conditions.keys()]) this.set(name, null);
    }

    sort(name, direction) {
      this.sortedBy = [name, direction];
      this.order = null;
    }

    // Apply the conditions to newly loaded rows.
    rowsAdded() {
      this.order = null;
      for (const name of this.conditions.keys()) this._judge(name);
    }

    _judge(name) {
      const { failures } = this;
      const rows = this.columns.rows;
      const old = this.fails.get(name);
      if (old) for (let row = 0; row < old.length; row++) failures[row] -= old[row];
      const condition = this.conditions.get(name);
      if (!condition) {
        this.fails.delete(name);
        return;
      }
      const fails = new Uint8Array(rows);
      const values = this.columns.values[name];
      if (condition instanceof Set) {
        for (let row = 0; row < rows; row++) fails[row] = condition.has(values[row]) ? 0 : 1;
      } else {
        const [low, high] = condition;
        for (let row = 0; row < rows; row++) fails[row] = values[row] >= low && values[row] <= high ? 0 : 1;
      }
      for (let row = 0; row < rows; row++) failures[row] += fails[row];
      this.fails.set(name, fails);
    }

    // Indices of the chosen rows, sorted; NaN comes last.
    rows() {
      const [name, direction] = this.sortedBy;
      if (!this.order) {
        this.order = Uint32Array.from({ length: this.columns.rows }, (_, row) => row);
        const values = this.columns.values[name];
        if (name !== "level_id" || direction < 0) {
          this.order.sort((a, b) => {
            const [x, y] = [values[a], values[b]];
            if (Number.isNaN(x)) return Number.isNaN(y) ? a - b : 1;
            return Number.isNaN(y) ? -1 : direction * (x - y) || a - b;
          });
        }
      }
      return this.order.filter((row) => this.failures[row] === 0);
    }

    // Count the rows of each word among those that fail no other condition.
    counts(name, words) {
      const found = new Uint32Array(words);
      const [values, own] = [this.columns.values[name], this.fails.get(name)];
      for (let row = 0; row < this.columns.rows; row++) {
        if (this.failures[row] - (own ? own[row] : 0) === 0 && values[row] < words) found[values[row]]++;
      }
      return found;
    }

    // Count the rows in each bin: all of them, and those that fail no other condition.
    histogram(name, bins) {
      const [all, chosen] = [new Uint32Array(bins.count), new Uint32Array(bins.count)];
      const [values, own] = [this.columns.values[name], this.fails.get(name)];
      for (let row = 0; row < this.columns.rows; row++) {
        if (Number.isNaN(values[row])) continue;
        const bin = Math.min(bins.count - 1, Math.floor((values[row] - bins.low) / bins.width));
        all[bin]++;
        if (this.failures[row] - (own ? own[row] : 0) === 0) chosen[bin]++;
      }
      return { all, chosen };
    }
  }

  // Bins that cover a column's numbers; null if it has fewer than two distinct ones.
  function binsOf(columns, name) {
    const values = columns.values[name];
    let [low, high, whole] = [Infinity, -Infinity, true];
    for (let row = 0; row < columns.rows; row++) {
      const value = values[row];
      if (Number.isNaN(value)) continue;
      if (value < low) low = value;
      if (value > high) high = value;
      if (whole && !Number.isInteger(value)) whole = false;
    }
    if (!(high > low)) return null;
    if (!whole) return { low, high, whole, count: BINS, width: (high - low) / BINS };
    const width = Math.ceil((high - low + 1) / BINS);
    return { low, high, whole, count: Math.ceil((high - low + 1) / width), width };
  }

  Object.assign(window.levelproof, { Choice, binsOf });
})();
