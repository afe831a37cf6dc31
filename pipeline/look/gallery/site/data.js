// Data of the gallery. Data files are scripts that pass a value to `arrived`, because pages opened from disk may load
// only scripts. Knows nothing of presentation.
"use strict";

(function () {
  const { bytesOf, worldOf } = window.levelproof;
  const BLOCKS = 128; // maximum number of blocks of worlds kept
  const waiting = new Map(); // name: {promise, resolve, reject}

  // Called by every data file.
  window.levelproof.arrived = function (name, value) {
    const pending = waiting.get(name);
    if (pending) pending.resolve(value);
  };

  // Load the value of a data file; reject if there is none.
  function load(name) {
    if (waiting.has(name)) return waiting.get(name).promise;
    const pending = {};
    pending.promise = new Promise((resolve, reject) => Object.assign(pending, { resolve, reject }));
    waiting.set(name, pending);
    const script = document.createElement("script");
    script.src = `data/${name}.js`;
    const ended = () => {
      waiting.delete(name);
      script.remove();
    };
    script.onload = () => {
      ended();
      pending.reject(new Error(`data/${name}.js has other data`)); // no effect if the value has arrived
    };
    script.onerror = () => {
      ended();
      pending.reject(new Error(`data/${name}.js cannot be read`));
    };
    document.head.append(script);
    return pending.promise;
  }

  // The manifest's columns, loaded page by page; `rows` have arrived. Missing numbers are NaN; words are indices into
  // the column's list.
  class Columns {
    constructor(about) {
      this.about = about;
      this.rows = 0;
      this.values = {};
      this.numbers = new Map(); // level id: row index
      for (const { name, words, bits } of about.columns) {
        const Kind = words ? Uint16Array : bits === 64 ? Float64Array : Float32Array;
        this.values[name] = new Kind(about.levels);
      }
    }

    add(page) {
      let count = 0;
      for (const [name, text] of Object.entries(page)) {
        const into = this.values[name];
        const values = new into.constructor(bytesOf(text).buffer);
        into.set(values, this.rows);
        count = values.length;
      }
      const ids = this.values.level_id;
      for (let row = this.rows; row < this.rows + count; row++) this.numbers.set(ids[row], row);
      this.rows += count;
    }

    // The list of a column's words; undefined if it has numbers, or there is none of that name.
    words(name) {
      return this.about.columns.find((column) => column.name === name)?.words;
    }
  }

  // Worlds by row, in blocks; the most recently used blocks are kept.
  class Worlds {
    constructor(about) {
      this.about = about;
      this.blocks = new Map(); // block index: base64 strings
    }

    has(row) {
      return this.blocks.has(Math.floor(row / this.about.block));
    }

    // The world if its block is loaded, else null.
    now(row) {
      const number = Math.floor(row / this.about.block);
      const block = this.blocks.get(number);
      if (!block) return null;
      this.blocks.delete(number); // move to the end: most recently used
      this.blocks.set(number, block);
      return worldOf(block[row % this.about.block]);
    }

    async get(row) {
      const number = Math.floor(row / this.about.block);
      if (!this.blocks.has(number)) {
        this.blocks.set(number, await load(`worlds/${number}`));
        if (this.blocks.size > BLOCKS) this.blocks.delete(this.blocks.keys().next().value);
      }
      return this.now(row);
    }
  }

  Object.assign(window.levelproof, { load, Columns, Worlds });
})();
