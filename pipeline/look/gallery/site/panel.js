// The filters beside the grid: buttons for words, histograms to brush for numbers. A filter sets its condition in the
// choice and is refreshed after every change.
"use strict";

(function () {
  const { binsOf, create } = window.levelproof;
  const FIRST = ["steps_to_goal", "env_steps", "success_rate", "portability", "bodies", "joints", "motors", "thrusters"];
  const [FEW, SHORT] = [8, 24]; // maximum number of words, and of their letters, for buttons; else a list
  const [WIDE, HIGH] = [320, 46]; // size of a histogram's view box
  const SLACK = 1e-9; // share of a bin by which ends of bins may be rounded
  const OPEN = [-Infinity, Infinity]; // limits that nobody chose, and fields without a number

  const readable = (name) => name.replaceAll("_", " ");

  function formatted(value) {
    if (Number.isInteger(value) || Math.abs(value) >= 1000) return Math.round(value).toLocaleString("en");
    return Number(value.toPrecision(3)).toString();
  }

  class Words {
    constructor(column, choice, changed) {
      Object.assign(this, { column, choice, changed });
      const heading = create("h3", {}, readable(column.name));
      if (column.words.length <= FEW && column.words.every((word) => word.length <= SHORT)) {
        this.buttons = column.words.map((word, index) =>
          create("button", { type: "button", "aria-pressed": "false", click: () => this.toggle(index) },
            ...(column.name === "label" ? [create("i", { class: "dot", "data-label": word })] : []), word, create("span")));
        this.element = create("div", { class: "filter", role: "group", "aria-label": readable(column.name) }, heading,
          create("div", { class: "chips" }, ...this.buttons));
      } else {
        this.select = create("select", { "aria-label": readable(column.name), change: () => this.pick() },
          create("option", { value: "" }, "any"),
          ...column.words.map((word, index) => create("option", { value: index }, word)));
        this.element = create("div", { class: "filter" }, heading, this.select);
      }
    }

    toggle(index) {
      const chosen = new Set(this.choice.conditions.get(this.column.name) || []);
      if (!chosen.delete(index)) chosen.add(index);
      this.choice.set(this.column.name, chosen.size ? chosen : null);
      this.changed();
    }

    pick() {
      this.choice.set(this.column.name, this.select.value === "" ? null : new Set([Number(this.select.value)]));
      this.changed();
    }

    refresh() {
      const chosen = this.choice.conditions.get(this.column.name);
      if (this.select) {
        this.select.value = chosen ? String([...chosen][0]) : "";
        return;
      }
      const counts = this.choice.counts(this.column.name, this.column.words.length);
      this.buttons.forEach((button, index) => {
        button.setAttribute("aria-pressed", String(Boolean(chosen && chosen.has(index))));
        button.lastChild.textContent = counts[index].toLocaleString("en");
      });
    }
  }

  class Histogram {
    constructor(name, choice, changed) {
      Object.assign(this, { name, choice, changed, bins: null });
      const path = (name) => create("path", { svg: true, class: name });
      [this.all, this.chosen] = [path("all"), path("chosen")];
      this.brush = create("rect", { svg: true, class: "brush", y: 0, height: HIGH });
      this.drawing = create("svg", {
        svg: true, viewBox: `0 0 ${WIDE} ${HIGH}`, preserveAspectRatio: "none", role: "img",
        pointerdown: (event) => this.begin(event), pointermove: (event) => this.drag(event), pointerup: () => this.end(),
        pointercancel: () => this.end(false),
      }, this.all, this.brush, this.chosen);
      this.clear = create("button", { type: "button", "aria-label": `Clear ${readable(name)}`, click: () => this.choose(null) }, "clear");
      this.inputs = ["at least", "at most"].map((words, end) =>
        create("input", { type: "number", step: "any", "aria-label": `${readable(name)}, ${words}`, change: () => this.typed(end) }));
      this.element = create("div", { class: "filter histogram" }, create("h3", {}, readable(name), this.clear), this.drawing,
        create("div", { class: "ends" }, ...this.inputs));
    }

    // Bin under the pointer.
    binAt(event) {
      const { left, width } = this.drawing.getBoundingClientRect();
      const bin = Math.floor(((event.clientX - left) / width) * this.bins.count);
      return Math.min(this.bins.count - 1, Math.max(0, bin));
    }

    begin(event) {
      if (event.button) return;
      this.from = this.binAt(event);
      this.moved = false;
      this.drawing.setPointerCapture(event.pointerId);
    }

    drag(event) {
      if (this.from === undefined) return;
      const to = this.binAt(event);
      if (to === this.from && !this.moved) return;
      if (this.moved && to === this.to) return;
      [this.moved, this.to] = [true, to];
      this.choose(this.range(Math.min(this.from, to), Math.max(this.from, to)), true);
    }

    // A click chooses one bin; a brush ends.
    end(clicks = true) {
      if (this.from === undefined) return;
      if (this.moved) this.changed();
      else if (clicks) this.choose(this.range(this.from, this.from));
      this.from = undefined;
    }

    // The values of some bins, which do not include their upper end. The first and the last bin are open: rows that are
    // yet to come may lie beyond them.
    range(first, last) {
      const { low, width, whole, count } = this.bins;
      const end = low + (last + 1) * width;
      return [first ? low + first * width : OPEN[0], last === count - 1 ? OPEN[1] : whole ? end - 1 : end - SLACK * width];
    }

    // Take the limit that was typed, 0 the lower or 1 the upper; the other stays.
    typed(end) {
      const range = [...(this.choice.conditions.get(this.name) || OPEN)];
      range[end] = this.inputs[end].value === "" ? OPEN[end] : Number(this.inputs[end].value);
      if (range[0] > range[1]) range[1 - end] = range[end];
      this.choose(range.some(Number.isFinite) ? range : null);
    }

    choose(range, brushing = false) {
      this.choice.set(this.name, range);
      this.changed(brushing);
    }

    refresh() {
      this.element.hidden = !this.bins;
      if (!this.bins) return;
      const { low, high, count, width } = this.bins;
      const { all, chosen } = this.choice.histogram(this.name, this.bins);
      const most = Math.max(1, ...all);
      const range = this.choice.conditions.get(this.name);
      const bars = (counts) => Array.from(counts, (total, bin) => {
        const [x, next] = [(bin * WIDE) / count, ((bin + 0.86) * WIDE) / count];
        const tall = total && Math.max(1.2, (HIGH * total) / most);
        return total ? `M${x.toFixed(1)} ${HIGH}V${(HIGH - tall).toFixed(1)}H${next.toFixed(1)}V${HIGH}Z` : "";
      }).join("");
      this.all.setAttribute("d", bars(all));
      const within = chosen.map((total, bin) => {
        const middle = low + (bin + 0.5) * width;
        const slack = this.bins.whole ? 0 : SLACK * width;
        return range && (middle + width / 2 <= range[0] + slack || middle - width / 2 > range[1]) ? 0 : total;
      });
      this.chosen.setAttribute("d", bars(within));
      const at = (value) => Math.min(WIDE, Math.max(0, ((value - low) / (count * width)) * WIDE));
      this.brush.setAttribute("x", range ? at(range[0]) : 0);
      this.brush.setAttribute("width", range ? Math.max(2, at(range[1] + (this.bins.whole ? 1 : 0)) - at(range[0])) : 0);
      this.clear.hidden = !range;
      [low, high].forEach((end, i) => {
        this.inputs[i].placeholder = formatted(end);
        this.inputs[i].value = range && Number.isFinite(range[i]) ? String(range[i]) : "";
      });
      const total = chosen.reduce((sum, rows) => sum + rows, 0);
      this.drawing.setAttribute("aria-label", `Histogram of ${readable(this.name)}: ${total} levels between ${formatted(low)} and ${formatted(high)}`);
    }
  }

  class Panel {
    constructor(columns, choice, changed) {
      Object.assign(this, { columns, choice });
      const worded = columns.about.columns.filter((column) => column.words);
      const isFlag = (column) => column.words.every((word) => word === "yes" || word === "no");
      const words = worded.map((column) => ({ column, filter: new Words(column, choice, changed) }));
      const named = columns.about.columns.filter((column) => !column.words && column.name !== "level_id").map((column) => column.name);
      const histograms = [...FIRST.filter((name) => named.includes(name)), ...named.filter((name) => !FIRST.includes(name))]
        .map((name) => new Histogram(name, choice, changed));
      this.histograms = histograms;
      this.filters = [...words.map(({ filter }) => filter), ...histograms];
      const at = (id) => document.getElementById(id);
      this.more = at("more").parentElement;
      this.more.addEventListener("toggle", () => this.refresh());
      at("words").append(...words.filter((entry) => !isFlag(entry.column)).map((entry) => entry.filter.element));
      at("histograms").append(...histograms.filter((entry) => FIRST.includes(entry.name)).map((entry) => entry.element));
      at("more").append(...words.filter((entry) => isFlag(entry.column) && entry.column.words.length > 1).map((entry) => entry.filter.element),
        ...histograms.filter((entry) => !FIRST.includes(entry.name)).map((entry) => entry.element));
    }

    // Update the bins for newly loaded rows.
    rowsAdded() {
      for (const histogram of this.histograms) histogram.bins = binsOf(this.columns, histogram.name);
    }

    // Refresh visible filters; folded ones refresh when they are unfolded.
    refresh() {
      for (const filter of this.filters) {
        if (this.more.open || !this.more.contains(filter.element)) filter.refresh();
      }
    }
  }

  Object.assign(window.levelproof, { Panel, readable, formatted });
})();
