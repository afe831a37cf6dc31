// Manual control: keys and pads set actions; the engine takes env steps in real time, or slower.
"use strict";

(function () {
  const { create, keyOf, usesKey, liveEntries, entryName, many } = window.levelproof;
  const at = (id) => document.getElementById(id);
  // Key: [entry of the action, value]; as in the reference's editor, plus letters for the motors it has no keys for.
  const KEYS = {
    ArrowLeft: [0, 1], ArrowRight: [0, 2], ArrowUp: [1, 1], ArrowDown: [1, 2],
    a: [2, 1], d: [2, 2], w: [3, 1], s: [3, 2], 1: [4, 1], 2: [5, 1],
  };
  const NAMES = { ArrowLeft: "←", ArrowRight: "→", ArrowUp: "↑", ArrowDown: "↓", a: "A", d: "D", w: "W", s: "S" };

  const steps = (count) => many(count, "step");

  class Player {
    constructor(link, stage) {
      Object.assign(this, { link, stage, playing: false, held: new Set(), codes: new Map(), busy: false, shown: 0 });
      at("play").addEventListener("click", () => this.play(!this.playing));
      at("step").addEventListener("click", () => { this.play(false); this.step(); });
      at("restart").addEventListener("click", () => this.restart());
      at("watch").addEventListener("click", () => this.watch());
      at("attempt").addEventListener("click", () => this.attempt());
      addEventListener("keydown", (event) => this.key(event, true));
      addEventListener("keyup", (event) => this.key(event, false)); // never comes for keys held with Meta on a Mac
      addEventListener("blur", () => { for (const key of [...this.held]) this.release(key); });
      levelproof.leaveAfterMouse(at("speed"));
    }

    open(level) {
      this.play(false);
      this.watching = null; // a film of the level before
      this.level = level;
      this.ended = false;
      this.held.clear(); // a pad that goes while it is held never says that it is released
      this.pads();
      this.clock(0);
      this.say("");
      at("watch").disabled = at("save-witness").disabled = !level.witness;
      at("of-policy").hidden = !level.policy;
    }

    // Show a button for each key that an actuator obeys.
    pads() {
      const live = liveEntries(this.stage.world);
      const keys = Object.entries(KEYS).filter(([, [entry]]) => live.includes(entry)).sort((a, b) => a[1][0] - b[1][0]);
      this.buttons = new Map();
      at("pads").replaceChildren(...keys.map(([key, [entry, value]]) => {
        const effect = entry < 4 ? ["", "forward", "back"][value] : "on";
        const release = () => this.release(key);
        const press = (event) => {
          if (event.button) return;
          button.setPointerCapture(event.pointerId);
          this.press(key);
        };
        const button = create("button", {
          type: "button", style: `--colour: var(--binding-${entry})`, pointerdown: press, pointerup: release, pointercancel: release,
        }, `${NAMES[key] || key} ${entryName(entry)} ${effect}`);
        this.buttons.set(key, button);
        return button;
      }));
      if (!keys.length) at("pads").textContent = "Nothing acts in this level: add a motor or a thruster.";
    }

    key(event, down) {
      if (!down) { // what a key pressed is released with it, whatever else is held by then
        this.release(this.codes.get(event.code));
        this.codes.delete(event.code);
        return;
      }
      const key = keyOf(event);
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (usesKey(event.target, key) && !event.target.closest("#pads")) return;
      if (this.buttons && this.buttons.has(key)) {
        event.preventDefault();
        if (event.repeat) return;
        this.codes.set(event.code, key);
        this.press(key);
      } else if (key === "r") this.restart();
      else if (key === " ") {
        event.preventDefault();
        this.play(!this.playing);
      }
    }

    press(key) {
      this.held.add(key);
      this.buttons.get(key).classList.add("lit");
      if (!this.playing && !this.ended) this.play(true);
    }

    release(key) {
      this.held.delete(key);
      if (this.buttons?.has(key)) this.buttons.get(key).classList.remove("lit");
    }

    action() {
      const action = [0, 0, 0, 0, 0, 0];
      for (const key of this.held) action[KEYS[key][0]] = KEYS[key][1];
      return action;
    }

    async play(playing) {
      if (playing && this.ended) await this.restart();
      if (playing === this.playing) return;
      this.playing = playing;
      at("play").textContent = playing ? "Pause" : "Play";
      if (!playing) return;
      this.watching = null;
      let due = performance.now();
      const turn = (this.turn = {}); // a loop that waits for a slow step must not go on beside the next one
      const frame = async (now) => {
        if (!this.playing || this.turn !== turn) return;
        const pace = (1000 * this.level.seconds) / Number(at("speed").value);
        if (now >= due && !this.busy) {
          due = Math.max(due + pace, now - pace);
          await this.step();
        }
        requestAnimationFrame(frame);
      };
      requestAnimationFrame(frame);
    }

    async step() {
      if (this.busy) return;
      if (this.ended) await this.restart();
      this.busy = true;
      try {
        const action = this.action();
        const moment = await this.link.ask("step", { action });
        this.stage.show(moment.places, action);
        this.clock(moment.timestep);
        if (moment.done) this.end(moment);
      } catch (error) {
        this.play(false);
        levelproof.problem(error.message);
      } finally {
        this.busy = false;
      }
    }

    end(moment) {
      this.play(false);
      this.ended = true;
      const over = moment.failed ? "Green touched red." : moment.broken ? "The world breaks down." : "Time is up.";
      const what = moment.kept ? ": save it below." : `, but a witness has at most ${this.level.longest}: reach the goal sooner to save it.`;
      this.say(moment.goal ? `Solved in ${steps(moment.timestep)}${what}` : over, moment.goal);
      if (moment.kept) at("watch").disabled = at("save-witness").disabled = false;
    }

    async restart() {
      this.ended = false;
      this.watching = null;
      try {
        const moment = await this.link.ask("restart");
        this.stage.show(moment.places, null);
        this.clock(0);
        this.say("");
      } catch (error) {
        levelproof.problem(error.message);
      }
    }

    // Go to the start, which edits apply to; stay there if it is what the page shows.
    rewind() {
      const there = !this.playing && !this.watching && !this.shown;
      this.play(false);
      if (!there) this.restart();
    }

    // Play the witness.
    async watch() {
      try {
        this.film(await this.link.ask("play"));
      } catch (error) {
        levelproof.problem(error.message);
      }
    }

    // Play the policy's next attempt.
    async attempt() {
      at("attempt").disabled = true; // the first one compiles
      try {
        const film = await this.link.ask("attempt");
        if (film.goal) at("watch").disabled = at("save-witness").disabled = false;
        const within = `in ${steps(film.actions.length)}`;
        this.film(film, film.goal ? `The policy reaches the goal ${within}: save it below.` : `The policy fails ${within}.`);
      } catch (error) {
        levelproof.problem(error.message);
      } finally {
        at("attempt").disabled = false;
      }
    }

    film(film, words = `The witness reaches the goal in ${steps(film.actions.length)}.`) {
      this.play(false);
      this.ended = true;
      this.watching = film;
      let before = performance.now();
      let time = 0;
      const frame = (now) => {
        if (this.watching !== film) return;
        time += ((now - before) / 1000 / this.level.seconds) * Number(at("speed").value);
        before = now;
        const step = Math.min(Math.floor(time), film.places.length - 1);
        this.stage.show(film.places[step], film.actions[step] || null);
        this.clock(step);
        if (step === film.places.length - 1) {
          this.watching = null;
          this.say(words, film.goal !== false);
        } else requestAnimationFrame(frame);
      };
      requestAnimationFrame(frame);
    }

    clock(step) {
      this.shown = step;
      at("clock").textContent = `step ${step} of ${this.level.steps} · ${(step * this.level.seconds).toFixed(1)} s`;
    }

    say(words, goal = false) {
      at("outcome").textContent = words;
      at("outcome").dataset.goal = goal;
    }
  }

  levelproof.Player = Player;
})();
