// The canvas: the current world, and what is selected.
"use strict";

(function () {
  const { attached, drawWorld, coloursOf, fit, worldOf } = window.levelproof;

  // The bodies, joints or thrusters of a world, or their numbers in a level.
  const listOf = (kind, of) => of[{ body: "bodies", joint: "joints", thruster: "thrusters" }[kind]];

  class Stage {
    constructor(canvas) {
      this.canvas = canvas;
      this.world = null;
      this.places = null;
      this.action = null;
      this.selected = null;
      this.colours = coloursOf();
      new ResizeObserver(() => this.fit()).observe(canvas);
      matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
        this.colours = coloursOf();
        this.draw();
      });
    }

    // Show a level as the server describes it.
    open(level) {
      this.level = level;
      this.world = worldOf(level.world);
      this.show(this.world.start, null);
    }

    show(places, action) {
      this.places = places;
      this.action = action;
      this.draw();
    }

    fit() {
      if (fit(this.canvas)) this.draw();
    }

    draw() {
      if (!this.world || !this.canvas.width) return;
      drawWorld(this.canvas, this.world, this.colours, { places: this.places, action: this.action });
      const point = this.selected && this.pointOf(this.selected);
      if (!point) return;
      const context = this.canvas.getContext("2d");
      context.beginPath();
      context.arc(point[0], point[1], this.selected.kind === "body" ? 0.12 : 0.16, 0, 2 * Math.PI);
      context.strokeStyle = this.colours.ink;
      context.lineWidth = 0.035;
      context.setLineDash([0.07, 0.05]);
      context.stroke();
      context.setLineDash([]);
    }

    // Position of a body, joint or thruster, m; `index` is in drawing order.
    pointOf({ kind, index }) {
      const places = this.places || this.world.start;
      if (kind === "body") return index < this.world.bodies.length ? [places[3 * index], places[3 * index + 1]] : null;
      const entity = listOf(kind, this.world)[index];
      return entity ? attached(places, entity.body, entity.anchor || entity.position) : null;
    }
  }

  Object.assign(levelproof, { Stage, listOf });
})();
