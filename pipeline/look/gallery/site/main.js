// Entry point: connects the parts. The address says what the page shows: `#level=7`, or conditions and an order such
// as `#label=solved&steps_to_goal=3..40&sort=-env_steps`.
"use strict";

(async function () {
  const { load, Columns, Worlds, Choice, Panel, Grid, LevelPage, create, readable, many } = window.levelproof;
  const at = (id) => document.getElementById(id);
  let columns, worlds, choice, panel, grid, page, rows, scrolled = 0, overview = "", waiting = false;

  // Show a problem; "" clears it.
  levelproof.report = (problem) => { at("problem").textContent = problem; };

  const hrefOf = (row) => `#level=${columns.values.level_id[row]}`;

  // Encode the conditions and the order as an address.
  function addressOf() {
    const parts = [...choice.conditions].map(([name, condition]) => {
      const value = condition instanceof Set ? [...condition].map((index) => columns.words(name)[index])
        : [condition.map((end) => (Number.isFinite(end) ? end : "")).join("..")];
      return `${name}=${value.map(encodeURIComponent).join(",")}`;
    });
    const [name, direction] = choice.sortedBy;
    if (name !== "level_id" || direction < 0) parts.push(`sort=${direction < 0 ? "-" : ""}${name}`);
    return `#${parts.join("&")}`;
  }

  // Decode a word of an address; "" if it is cut off, as in a shortened link.
  function decoded(word) {
    try {
      return decodeURIComponent(word);
    } catch {
      return "";
    }
  }

  // Decode an address into conditions and an order; ignore unknown words and columns.
  function choose(address) {
    choice.clear();
    choice.sort("level_id", 1);
    for (const part of address.slice(1).split("&").filter(Boolean)) {
      const [name, value = ""] = part.split("=");
      if (name === "sort" && columns.values[value.replace("-", "")]) choice.sort(value.replace("-", ""), value[0] === "-" ? -1 : 1);
      const words = columns.words(name);
      if (words) {
        const indices = value.split(",").map((word) => words.indexOf(decoded(word))).filter((index) => index >= 0);
        if (indices.length) choice.set(name, new Set(indices));
      } else if (columns.values[name]) {
        const [low, high] = value.split("..");
        const range = [low === "" ? -Infinity : Number(low), high === "" ? Infinity : Number(high)];
        if (range[0] <= range[1]) choice.set(name, range);
      }
    }
  }

  function refresh() {
    rows = choice.rows();
    const [name, direction] = choice.sortedBy;
    const { levels, found } = columns.about;
    const some = rows.length === columns.rows ? "" : `${rows.length.toLocaleString("en")} of `;
    const all = columns.rows < levels ? `${many(columns.rows, "level")}, more to come` : many(levels, "level");
    at("count").textContent = some + all + (found > levels ? ` (spread evenly over ${found.toLocaleString("en")})` : "");
    at("clear").hidden = !choice.conditions.size;
    at("sort").value = name;
    at("direction").textContent = direction < 0 ? "↓" : "↑";
    at("direction").setAttribute("aria-pressed", String(direction < 0));
    panel.refresh();
    grid.show(rows, name === "level_id" ? "steps_to_goal" : name);
    if (page.row !== null) neighbours(page.row);
  }

  // Show a changed choice. Browsers refuse addresses that change often, so a brush writes it at its end.
  function changed(brushing = false) {
    overview = addressOf();
    refresh();
    if (brushing) return;
    try {
      history.replaceState(null, "", overview);
    } catch (error) {
      if (error.name !== "SecurityError") throw error; // the page shows the choice; the next change writes the address
    }
  }

  // Link a level's page to the levels before and after it, among those chosen.
  function neighbours(row) {
    const index = rows ? rows.indexOf(row) : -1;
    for (const [name, other] of [["previous", index - 1], ["next", index < 0 ? -1 : index + 1]]) {
      if (rows && rows[other] !== undefined) at(name).href = hrefOf(rows[other]);
      else at(name).removeAttribute("href");
    }
  }

  // Show what the address names.
  function follow() {
    const address = location.hash || "#";
    const id = address.match(/^#level=(-?\d+)$/);
    levelproof.report("");
    waiting = false;
    if (!id) {
      const left = page.row;
      page.open(null);
      [at("overview").hidden, at("level").hidden] = [false, true];
      document.title = `${columns.about.split} · levelproof gallery`;
      if (address !== overview) {
        overview = address;
        choose(address);
        refresh();
      } else grid.layout();
      scrollTo(0, scrolled);
      if (left !== null && rows.length) grid.move(rows.indexOf(left)); // the focus goes to its cell, or to the first
      return;
    }
    const row = columns.numbers.get(Number(id[1]));
    if (row === undefined) {
      waiting = columns.rows < columns.about.levels; // it may be on a page that is still loading
      if (waiting) return;
      history.replaceState(null, "", overview || "#");
      follow();
      levelproof.report(`There is no level ${id[1]} in this gallery.`);
      return;
    }
    if (!at("overview").hidden) scrolled = scrollY;
    [at("overview").hidden, at("level").hidden] = [true, false];
    at("back").href = overview || "#";
    neighbours(row);
    scrollTo(0, 0);
    page.open(row).then(
      () => { if (page.row === row) at("level").focus({ preventScroll: true }); },
      (error) => { if (page.row === row) levelproof.report(error.message); },
    );
  }

  function listen() {
    addEventListener("hashchange", follow);
    at("clear").addEventListener("click", () => { choice.clear(); changed(); });
    at("sort").addEventListener("change", () => { choice.sort(at("sort").value, choice.sortedBy[1]); changed(); });
    at("direction").addEventListener("click", () => { choice.sort(choice.sortedBy[0], -choice.sortedBy[1]); changed(); });
    document.querySelector(".skip").addEventListener("click", (event) => {
      event.preventDefault();
      (at("level").hidden ? at("levels") : at("level")).focus();
    });
    at("search").addEventListener("submit", (event) => {
      event.preventDefault();
      const id = at("level-id").value.trim();
      const coming = columns.rows < columns.about.levels;
      if (/^-?\d+$/.test(id) && (coming || columns.numbers.has(Number(id)))) location.hash = `level=${Number(id)}`;
      else levelproof.report(id ? `There is no level ${id} in this gallery.` : "Type the id of a level.");
    });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
      grid.recolour();
      page.recolour();
    });
  }

  try {
    const about = await load("about");
    [columns, worlds] = [new Columns(about), new Worlds(about)];
    choice = new Choice(columns);
    panel = new Panel(columns, choice, changed);
    grid = new Grid(at("levels"), columns, worlds, hrefOf);
    page = new LevelPage(columns, worlds);
    at("split").textContent = about.split;
    at("facts").textContent = [`configuration ${about.config_hash}`, ...(about.where ? [`where ${about.where}`] : [])].join(" · ");
    const sorts = about.columns.filter((column) => !column.words).map((column) => column.name);
    at("sort").append(...sorts.map((name) => create("option", { value: name }, name === "level_id" ? "level id" : readable(name))));
    const narrow = matchMedia("(max-width: 820px)"); // as in style.css, which shows how to open it only there
    const fold = () => { at("panel").open = !narrow.matches; };
    fold();
    narrow.addEventListener("change", fold);
    listen();
    for (let number = 0; columns.rows < about.levels; number++) {
      columns.add(await load(`columns/${number}`));
      choice.rowsAdded();
      panel.rowsAdded();
      if (number === 0) {
        if (!/^#level=/.test(location.hash)) [overview, at("overview").hidden] = [location.hash || "#", false];
        choose(overview);
      }
      refresh();
      if (number === 0 || waiting) follow();
    }
    if (waiting) follow();
    performance.mark("all columns are there");
  } catch (error) {
    levelproof.report(`${error.message}: write the gallery again with levelproof gallery.`);
    throw error;
  }
})();
