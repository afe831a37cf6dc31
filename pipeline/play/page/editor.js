// Edits by pointer and buttons. The server applies them, so that the level is always valid for the engine.
"use strict";

(function () {
  const { create, keyOf, listOf, metresOf, usesKey } = window.levelproof;
  const at = (id) => document.getElementById(id);
  const NEAR = 0.14; // m; a click this near selects a joint or thruster
  const TURN = Math.PI / 12; // rad per click
  const GROW = 1.15; // factor per click
  const TOOLS = {
    select: ["Select", "Click a body, joint or thruster. Drag a body to move it with everything joined to it."],
    rectangle: ["Rectangle", "Click where the centre should be."],
    triangle: ["Triangle", "Click where the centre should be."],
    circle: ["Circle", "Click where the centre should be."],
    joint: ["Motor joint", "Click where two bodies overlap."],
    fixed: ["Fixed joint", "Click where two bodies overlap."],
    thruster: ["Thruster", "Press on a body, drag in the direction of the push, and release."],
  };

  class Editor {
    // `begin` shows the start of the level, which edits apply to.
    constructor(link, stage, changed, begin) {
      Object.assign(this, { link, stage, changed, begin, tool: "select", drag: null });
      const buttons = Object.entries(TOOLS).map(([tool, [words]]) => this.button(words, () => this.take(tool), { role: "radio", "data-tool": tool }));
      at("tools").replaceChildren(...buttons);
      for (const name of ["undo", "redo"]) at(name).addEventListener("click", () => this.change(name));
      stage.canvas.addEventListener("pointerdown", (event) => this.down(event));
      stage.canvas.addEventListener("pointermove", (event) => this.moved(event));
      stage.canvas.addEventListener("pointerup", (event) => this.up(event));
      stage.canvas.addEventListener("pointercancel", () => { this.drag = null; });
      addEventListener("keydown", (event) => this.key(event));
      this.take("select");
    }

    button(words, action, attributes = {}) {
      return create("button", { type: "button", click: action, ...attributes }, words);
    }

    take(tool) {
      this.tool = tool;
      for (const button of at("tools").children) button.setAttribute("aria-checked", button.dataset.tool === tool);
      at("hint").textContent = TOOLS[tool][1];
    }

    // Show a level as the server describes it, after an edit or from a file.
    open(level) {
      this.level = level;
      at("undo").disabled = !level.undo;
      at("redo").disabled = !level.redo;
      this.select(this.found(this.stage.selected));
    }

    // The same entity in the current level, whose drawing order may differ; null if it is gone.
    found(entity) {
      const index = entity ? listOf(entity.kind, this.level).indexOf(entity.number) : -1;
      return index < 0 ? null : { ...entity, index };
    }

    // Ask for a change, at the start of the level on the page and in the engine, which a refused change leaves as it is.
    async change(name, fields) {
      this.begin();
      try {
        this.changed(await this.link.ask(name, fields));
        levelproof.problem("");
      } catch (error) {
        levelproof.problem(error.message);
        this.stage.show(this.stage.world.start, null);
      }
    }

    edit(name, ...values) {
      return this.change("edit", { name, with: values });
    }

    async down(event) {
      if (event.button) return;
      const [x, y] = metresOf(this.stage.canvas, event);
      this.stage.canvas.setPointerCapture(event.pointerId);
      this.begin();
      this.stage.show(this.stage.world.start, null); // without waiting for the engine
      if (this.tool === "thruster") this.drag = { from: [x, y] };
      else if (this.tool === "joint" || this.tool === "fixed") await this.edit("add_joint", x, y, this.tool === "fixed");
      else if (this.tool !== "select") {
        await this.edit("add_body", this.tool, x, y);
        this.take("select");
      } else await this.pick(x, y);
    }

    // Select a joint or thruster near a point, else the topmost body there.
    async pick(x, y) {
      for (const kind of ["thruster", "joint"]) {
        for (const [index, number] of listOf(kind, this.level).entries()) {
          const point = this.stage.pointOf({ kind, index });
          if (Math.hypot(point[0] - x, point[1] - y) < NEAR) return this.select({ kind, index, number });
        }
      }
      this.drag = { from: [x, y] };
      const { bodies } = await this.link.ask("at", { x, y });
      const entity = this.found({ kind: "body", number: bodies[0] });
      this.select(entity);
      if (!this.drag || !entity || entity.number < 4) return;
      Object.assign(this.drag, { ...entity, start: Array.from(this.stage.world.start.slice(3 * entity.index, 3 * entity.index + 2)) });
    }

    moved(event) {
      if (!this.drag || this.drag.index === undefined) return;
      const [x, y] = metresOf(this.stage.canvas, event);
      const places = Array.from(this.stage.world.start);
      places[3 * this.drag.index] = this.drag.start[0] + x - this.drag.from[0];
      places[3 * this.drag.index + 1] = this.drag.start[1] + y - this.drag.from[1];
      this.stage.show(places, null);
    }

    async up(event) {
      const drag = this.drag;
      this.drag = null;
      if (!drag) return;
      const [x, y] = metresOf(this.stage.canvas, event);
      const [dx, dy] = [x - drag.from[0], y - drag.from[1]];
      const far = Math.hypot(dx, dy) > 0.02;
      if (this.tool === "thruster") await this.edit("add_thruster", ...drag.from, far ? Math.atan2(dy, dx) : Math.PI / 2);
      else if (far && drag.index !== undefined) await this.edit("move", drag.number, drag.start[0] + dx, drag.start[1] + dy);
    }

    select(entity) {
      this.stage.selected = entity;
      this.stage.draw();
      this.describeSelection();
    }

    // Show what is selected, and buttons for its edits.
    describeSelection() {
      const focused = at("deeds").contains(document.activeElement) && document.activeElement.textContent;
      this.describeEntity();
      const again = [...at("deeds").children].find((button) => button.textContent === focused);
      if (again) again.focus(); // every edit replaces the buttons
    }

    describeEntity() {
      const entity = this.stage.selected;
      at("selected").hidden = !entity;
      this.remove = null;
      if (!entity) return;
      const { kind, index, number } = entity;
      const scenery = kind === "body" && number < 4; // it cannot be deleted
      const remove = () => { this.stage.selected = null; this.edit("delete", kind, number); };
      if (!scenery) this.remove = this.button("Delete", remove);
      if (kind !== "body") {
        const { binding, fixed, motor, auto } = listOf(kind, this.stage.world)[index];
        const obeys = kind === "thruster" || (motor && !auto);
        const rest = fixed ? "Fixed joint" : motor ? "Motor that always runs" : "Joint without a motor";
        at("what").textContent = obeys ? `${kind === "joint" ? "Motor" : "Thruster"}, obeys ${levelproof.entryName(binding)}` : rest;
        const next = (kind === "joint" ? binding : binding - 4) + 1;
        at("deeds").replaceChildren(...(obeys ? [this.button("Next control", () => this.edit("bind", kind, number, next))] : []), this.remove);
        return;
      }
      const [role, fixed] = [this.stage.world.bodies[index].role, this.level.fixed[index]];
      at("what").textContent = `${role[0].toUpperCase()}${role.slice(1)} body${fixed ? ", cannot move" : ""}`;
      const roles = this.level.roles.map((name, value) =>
        this.button(name, () => this.edit("set_role", number, value), { "aria-pressed": name === role }));
      at("deeds").replaceChildren(...roles, ...(scenery ? [] : [
        this.button(fixed ? "Let it move" : "Fix it", () => this.edit("fix", number, !fixed)),
        this.button("Turn ↺", () => this.edit("turn", number, TURN)),
        this.button("Turn ↻", () => this.edit("turn", number, -TURN)),
        this.button("Larger", () => this.edit("resize", number, GROW)),
        this.button("Smaller", () => this.edit("resize", number, 1 / GROW)),
        this.remove,
      ]));
    }

    key(event) {
      const key = keyOf(event);
      if (usesKey(event.target, key)) return;
      const isUndo = (event.ctrlKey || event.metaKey) && key === "z";
      if (isUndo) at(event.shiftKey ? "redo" : "undo").click(); // nothing happens if there is nothing to undo
      else if (key === "Delete" && this.remove) this.remove.click();
      else return;
      event.preventDefault();
    }
  }

  levelproof.Editor = Editor;
})();
