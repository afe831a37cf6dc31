// The grid of drawn levels. Only cells on the screen exist, however many levels are chosen.
"use strict";

(function () {
  const { create, drawWorld, formatted } = window.levelproof;
  const NARROWEST = 150; // px; minimum width of a cell
  const CAPTION = 34; // px; height of the caption below a picture
  const BEYOND = 1; // rows drawn ahead, above and below the screen
  const BUDGET = 6; // ms; time to draw per frame
  const LOADS = 6; // maximum number of blocks loading at a time
  const HIGHEST = 8e6; // px; browsers cut taller elements off, Firefox at 17.9 million

  class Grid {
    constructor(element, columns, worlds, hrefOf) {
      Object.assign(this, { element, columns, worlds, hrefOf });
      this.rows = new Uint32Array(0);
      this.cells = new Map(); // position in the grid: cell
      this.free = [];
      this.current = 0; // position of the keyboard focus
      this.queue = []; // cells to draw
      this.loading = 0;
      this.detail = "steps_to_goal"; // the column that captions show
      this.pace = 1; // pixels of the grid that a pixel of scrolling passes
      this.most = 0; // pixels of scrolling that pass so many; beyond, a pixel passes one
      this.shift = 0; // px; how much farther down that puts the cells
      this.colours = levelproof.coloursOf();
      this.asked = false;
      const later = () => this.later();
      addEventListener("scroll", later, { passive: true });
      const resized = new ResizeObserver(later);
      resized.observe(element);
      resized.observe(document.body); // content above may fold away
      element.addEventListener("keydown", (event) => this.key(event));
      element.addEventListener("focusin", (event) => {
        const cell = event.target.closest(".cell");
        if (cell) this.move(cell.index, false);
      });
    }

    // Show other rows, or captions. A cell with the keyboard focus stays with its row; others whose row stays where it is
    // are not drawn again.
    show(rows, detail) {
      const cells = [...this.cells.values()];
      const focused = cells.find((cell) => cell.element.contains(document.activeElement));
      if (focused && rows[focused.element.index] !== focused.row) focused.element.index = rows.indexOf(focused.row);
      Object.assign(this, { rows, detail, current: focused ? Math.max(0, focused.element.index) : 0 });
      this.cells.clear();
      for (const cell of cells) {
        const { index } = cell.element;
        if (rows[index] === cell.row) this.cells.set(index, this.fill(cell, index));
        else this.release(cell);
      }
      this.element.querySelector(".nothing")?.remove();
      if (!rows.length) this.element.append(create("p", { class: "nothing" }, "No level matches: clear a filter."));
      this.layout();
    }

    recolour() {
      this.colours = levelproof.coloursOf();
      for (const cell of this.cells.values()) this.want(cell);
    }

    later() {
      if (this.asked) return;
      this.asked = true;
      requestAnimationFrame(() => {
        this.asked = false;
        this.layout();
      });
    }

    layout() {
      const width = this.element.clientWidth;
      if (!width) return;
      const across = Math.max(2, Math.floor(width / NARROWEST / (width > 900 ? 1.15 : 1)));
      const [wide, tall] = [width / across, width / across + CAPTION];
      if (wide !== this.wide) {
        for (const cell of this.cells.values()) this.release(cell);
        this.cells.clear();
      }
      Object.assign(this, { across, wide, tall });
      const whole = Math.ceil(this.rows.length / across) * tall;
      this.element.style.height = whole ? `${Math.min(whole, HIGHEST)}px` : "";
      const height = whole ? this.element.getBoundingClientRect().height : 0; // in a zoomed browser, it may be less
      const pace = whole > height + 1 ? (whole - innerHeight) / (height - innerHeight) : 1;
      if (pace !== this.pace) {
        const above = -this.element.getBoundingClientRect().top - this.shift;
        [this.pace, this.most] = [pace, Math.max(0, height - innerHeight)];
        this.scroll(above);
      }
      const [top, before] = [-this.element.getBoundingClientRect().top, this.shift];
      this.shift = Math.min(Math.max(0, top), this.most) * (1 - this.pace);
      const above = top - this.shift;
      if (this.shift !== before) for (const [index, cell] of this.cells) this.place(cell, index);
      const first = Math.max(0, (Math.floor(above / tall) - BEYOND) * across);
      const last = Math.min(this.rows.length, (Math.ceil((above + innerHeight) / tall) + BEYOND) * across);
      for (const [index, cell] of this.cells) {
        if (index < first || index >= last) {
          if (cell.element.contains(document.activeElement)) continue; // keep the focused cell
          this.release(cell);
          this.cells.delete(index);
        }
      }
      for (let index = first; index < last; index++) {
        if (!this.cells.has(index)) this.cells.set(index, this.fill(this.free.pop() || this.cell(), index));
      }
      this.draw();
    }

    // Scroll until so many pixels of the grid are above the screen.
    scroll(above) {
      const within = Math.min(Math.max(0, above), this.most * this.pace);
      scrollBy(0, above - within + within / this.pace + this.element.getBoundingClientRect().top);
    }

    cell() {
      const canvas = create("canvas", { "aria-hidden": "true" });
      const [dot, name, detail] = [create("i", { class: "dot" }), create("span"), create("span")];
      const link = create("a", {}, canvas, create("p", { "aria-hidden": "true" }, dot, name, detail));
      const element = create("div", { class: "cell", role: "listitem" }, link);
      const cell = { element, link, canvas, dot, name, detail };
      this.element.append(element);
      return cell;
    }

    release(cell) {
      cell.row = undefined;
      cell.element.hidden = true;
      cell.element.removeAttribute("aria-posinset");
      this.free.push(cell);
    }

    fill(cell, index) {
      const row = this.rows[index];
      const id = this.columns.values.level_id[row];
      const label = this.columns.words("label")[this.columns.values.label[row]];
      const value = this.columns.values[this.detail][row];
      const unit = this.detail === "steps_to_goal" ? ` step${value === 1 ? "" : "s"}` : "";
      const detail = Number.isNaN(value) ? label : formatted(value) + unit;
      cell.element.index = index;
      cell.element.hidden = false;
      cell.element.style.width = `${this.wide}px`;
      cell.element.style.height = `${this.tall}px`;
      this.place(cell, index);
      cell.element.setAttribute("aria-posinset", index + 1);
      cell.element.setAttribute("aria-setsize", this.rows.length);
      cell.link.href = this.hrefOf(row);
      cell.link.tabIndex = index === this.current ? 0 : -1;
      const steps = this.columns.values.steps_to_goal[row];
      cell.link.setAttribute("aria-label", `Level ${id}, ${label}${Number.isNaN(steps) ? "" : `, ${steps} steps to the goal`}`);
      cell.dot.dataset.label = label;
      cell.name.textContent = id;
      cell.detail.textContent = detail;
      const pixels = Math.round((this.wide - 8) * Math.min(2, devicePixelRatio));
      if (cell.row === row && cell.canvas.width === pixels) return cell; // it has been drawn, or waits for that
      cell.row = row;
      if (cell.canvas.width !== pixels) cell.canvas.width = cell.canvas.height = pixels;
      else {
        const context = cell.canvas.getContext("2d");
        context.setTransform(1, 0, 0, 1, 0, 0);
        context.clearRect(0, 0, pixels, pixels);
      }
      this.want(cell);
      return cell;
    }

    place(cell, index) {
      const [x, y] = [(index % this.across) * this.wide, Math.floor(index / this.across) * this.tall + this.shift];
      cell.element.style.transform = `translate(${x}px, ${y}px)`;
    }

    want(cell) {
      this.queue.push({ cell, row: cell.row });
      this.later();
    }

    // Draw queued cells that are still on the screen, until the frame's time is up.
    draw() {
      const until = performance.now() + BUDGET;
      const left = [];
      for (const wanted of this.queue) {
        const { cell, row } = wanted;
        if (cell.row !== row) continue;
        const world = performance.now() < until ? this.worlds.now(row) : null;
        if (world) drawWorld(cell.canvas, world, this.colours);
        else left.push(wanted);
      }
      if (this.queue.length && !left.length && !this.painted) {
        this.painted = true;
        performance.mark("levels are drawn");
      }
      this.queue = left;
      for (const { row } of left) this.load(row);
      if (left.some(({ row }) => this.worlds.has(row))) this.later();
    }

    load(row) {
      if (this.loading >= LOADS || this.worlds.has(row)) return;
      this.loading++;
      const block = (index) => Math.floor(index / this.columns.about.block);
      this.worlds.get(row).catch((error) => {
        levelproof.report(error.message);
        const failed = (wanted) => block(wanted.row) === block(row);
        for (const { cell } of this.queue.filter(failed)) cell.row = undefined; // to be drawn when it is next filled
        this.queue = this.queue.filter((wanted) => !failed(wanted));
      }).finally(() => {
        this.loading--;
        this.later();
      });
    }

    move(index, focuses = true) {
      const before = this.cells.get(this.current);
      if (before) before.link.tabIndex = -1;
      this.current = Math.min(this.rows.length - 1, Math.max(0, index));
      if (focuses) {
        this.layout(); // the page may have scrolled since
        const above = -this.element.getBoundingClientRect().top - this.shift;
        const top = Math.floor(this.current / this.across) * this.tall - above;
        const by = top < 0 ? top - 8 : Math.max(0, top + this.tall - innerHeight + 8);
        if (by) this.scroll(above + by);
        this.layout();
      }
      const cell = this.cells.get(this.current);
      if (!cell) return;
      cell.link.tabIndex = 0;
      if (focuses) cell.link.focus({ preventScroll: true });
    }

    key(event) {
      const screen = this.across * Math.max(1, Math.floor(innerHeight / this.tall));
      const steps = {
        ArrowLeft: -1, ArrowRight: 1, ArrowUp: -this.across, ArrowDown: this.across, PageUp: -screen, PageDown: screen,
        Home: -this.rows.length, End: this.rows.length,
      };
      if (!(event.key in steps) || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      this.move(this.current + steps[event.key]);
    }
  }

  Object.assign(window.levelproof, { Grid });
})();
