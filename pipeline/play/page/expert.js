// An expert in training: its progress, learning curve, and current attempts.
"use strict";

(function () {
  const { create, drawCurve, drawWorld } = window.levelproof;
  const at = (id) => document.getElementById(id);
  const STAGES = {
    compiling: "Loading the programs of this size; the first time takes a minute",
    searching: "A search looks for a first success",
    training: "The expert trains",
    stopped: "Stopped",
  };
  const SMALL = 160; // px; side of an attempt's picture

  class Expert {
    constructor(link, stage, solved) {
      Object.assign(this, { link, stage, solved, running: false });
      at("train").addEventListener("click", () => this.toggle());
    }

    async toggle() {
      try {
        if (this.running) await this.link.ask("stop");
        else {
          this.world = this.stage.world;
          this.film = null;
          await this.link.ask("train");
          this.run(true);
        }
      } catch (error) {
        levelproof.problem(error.message);
      }
    }

    // Another level is on the page: a verdict on the one before goes, an expert goes on.
    open() {
      if (this.running) return;
      this.film = null;
      at("stage-of-training").textContent = "";
      at("learning").hidden = at("attempts").hidden = true;
    }

    run(running) {
      this.running = running;
      at("train").textContent = running ? "Stop" : "Train an expert for this level";
      if (running) at("learning").hidden = at("attempts").hidden = true;
    }

    // Show a progress message of the server.
    update(message) {
      if (message.attempts) return this.attempts(message);
      const { stage } = message;
      const steps = message.env_steps === undefined ? "" : `: ${message.env_steps.toLocaleString("en")} env steps`;
      at("stage-of-training").textContent = STAGES[stage] ? `${STAGES[stage]}${steps}.` : "";
      if (message.curve) drawCurve(at("curve"), message.curve);
      if (stage === "done") {
        const current = this.world === this.stage.world;
        const note = current ? "" : " It is about the level as it was when training began.";
        at("stage-of-training").textContent = `${message.label}: ${message.reason} (${message.env_steps.toLocaleString("en")} env steps).${note}`;
        if (message.film && current) this.solved(message.film);
      }
      if (stage === "failed") at("stage-of-training").textContent = message.reason;
      if (["done", "stopped", "failed"].includes(stage)) this.run(false);
    }

    attempts({ attempts, goals }) {
      at("attempts").hidden = false;
      if (at("attempts").children.length !== attempts.length) {
        at("attempts").replaceChildren(...attempts.map(() => create("canvas", { width: SMALL, height: SMALL })));
      }
      const began = performance.now();
      const film = (this.film = {});
      const frame = (now) => {
        if (this.film !== film) return;
        const step = Math.min(attempts[0].length - 1, Math.floor((now - began) / 1000 / this.stage.level.seconds));
        attempts.forEach((places, i) => {
          const canvas = at("attempts").children[i];
          drawWorld(canvas, this.world, this.stage.colours, { places: places[step] });
          canvas.classList.toggle("goal", goals[i]);
        });
        if (step < attempts[0].length - 1) requestAnimationFrame(frame);
      };
      requestAnimationFrame(frame);
    }
  }

  levelproof.Expert = Expert;
})();
