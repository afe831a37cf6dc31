// What the gallery knows: data come as scripts that hand over a value, because pages that are opened from the disk may
// load scripts and nothing else. Knows nothing of how anything looks.
"use strict";

(function () {
  const { bytesOf, worldOf } = window.levelproof;
  const BLOCKS = 128; // of worlds that are kept
  const waiting = new Map(); // name: {promise, resolve, reject}

  // Called by every data file.
  window.levelproof.arrived = function (name, value) {
    const asked = waiting.get(name);
    if (asked) asked.resolve(value);
  };

  // The value of a data file. Rejects where there is none.
  function load(name) {
    if (waiting.has(name)) return waiting.get(name).promise;
    const asked = {};
    asked.promise = new Promise((resolve, reject) => Object.assign(asked, { resolve, reject }));
    waiting.set(name, asked);
    const script = document.createElement("script");
    script.src = `data/${name}.js`;
    const ended = () => {
      waiting.delete(name);
      script.remove();
    };
    script.onload = () => {
      ended();
      asked.reject(new Error(`data/${name}.js has something else`)); // nothing, if it has arrived
    };
    script.onerror = () => {
      ended();
      asked.reject(new Error(`data/${name}.js cannot be read`));
    };
    document.head.append(script);
    return asked.promise;
  }

  // The manifest's columns, which come page by page: `rows` of them are there. Numbers are NaN where there is none,
  // words are places in the column's list.
  class Columns {
    constructor(about) {
      this.about = about;
      this.rows = 0;
      this.values = {};
      this.numbers = new Map(); // level id: number of its row
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

    word(name, row) {
      const { words } = this.about.columns.find((column) => column.name === name);
      return words[this.values[name][row]];
    }
  }

  // Worlds by the number of their rows, in blocks; the blocks that were asked for last are kept.
  class Worlds {
    constructor(about) {
      this.about = about;
      this.blocks = new Map(); // number: texts
    }

    has(row) {
      return this.blocks.has(Math.floor(row / this.about.block));
    }

    // The world, if its block is there; else null.
    now(row) {
      const number = Math.floor(row / this.about.block);
      const block = this.blocks.get(number);
      if (!block) return null;
      this.blocks.delete(number); // the last that was asked for goes to the end
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
