// The page of one level: its witness played from stored states, a policy's attempt beside it, its learning curve, the
// reason for its label.
"use strict";

(function () {
  const {
    load, create, keyOf, usesKey, readable, formatted, statesOf, between, bytesOf, liveEntries, entryName, drawWorld, many,
  } = window.levelproof;
  const ENTRIES = 6; // entries of an action
  const REST = 0.8; // s; pause on the last picture before the witness restarts
  const at = (id) => document.getElementById(id);

  class LevelPage {
    constructor(columns, worlds) {
      Object.assign(this, { columns, worlds, row: null, film: null, policy: null, steps: 0, playing: false });
      this.colours = levelproof.coloursOf();
      at("play").addEventListener("click", () => this.play(!this.playing));
      at("step-back").addEventListener("click", () => this.back());
      at("step-on").addEventListener("click", () => this.seek(Math.floor(this.time) + 1));
      at("scrub").addEventListener("input", () => this.seek(Number(at("scrub").value)));
      at("trails").addEventListener("change", () => this.draw());
      at("copy").addEventListener("click", () => this.copy("command", "copy"));
      at("copy-hands").addEventListener("click", () => this.copy("hands", "copy-hands"));
      levelproof.leaveAfterMouse(at("speed"));
      addEventListener("keydown", (event) => this.key(event));
      const observer = new ResizeObserver(() => this.fit());
      for (const stage of ["stage", "policy-stage"]) observer.observe(at(stage));
    }

    // Show the level of a row; null closes the page.
    async open(row) {
      this.play(false);
      Object.assign(this, { row, film: null, policy: null, steps: 0, world: null });
      if (row === null) return;
      document.querySelector("#level .columns").hidden = true; // it is about the level before
      const id = this.columns.values.level_id[row];
      const [world, data] = await Promise.all([this.worlds.get(row), load(`levels/${Math.floor(row / this.columns.about.folder)}/${id}`)]);
      if (this.row !== row) return; // another level was opened while this one loaded
      this.world = world;
      this.film = filmOf(world, data);
      this.policy = data.policy ? { ...filmOf(world, data.policy), solved: data.policy.solved } : null;
      this.steps = Math.max(0, ...[this.film, this.policy].filter(Boolean).map((film) => film.steps)); // of the longer
      this.now = new Float32Array(world.start.length);
      this.time = 0;
      document.querySelector("#level .columns").hidden = false;
      this.describe(data.row);
      this.fit();
      if (this.steps && !matchMedia("(prefers-reduced-motion: reduce)").matches) this.play(true);
    }

    describe(row) {
      const badge = create("span", { class: "badge" }, create("i", { class: "dot", "data-label": row.label }), row.label);
      at("title").replaceChildren(`Level ${row.level_id}`, badge);
      document.title = `Level ${row.level_id} · levelproof gallery`;
      const reason = row.label_reason;
      at("reason").textContent = `${reason[0].toUpperCase()}${reason.slice(1)}.`;
      at("command").textContent = row.command;
      at("hands").textContent = `levelproof play ${this.columns.about.quoted} ${row.level_id}`;
      at("controls").hidden = !this.steps;
      at("scrub").max = this.steps;
      this.keys = liveEntries(this.world).map((entry) => {
        const element = create("span", { class: "key", style: `--colour: var(--binding-${entry})` });
        return { entry, element, motor: entry < 4 };
      });
      at("keys").replaceChildren(...this.keys.map((key) => key.element));
      levelproof.drawCurve(at("curve"), row.learning_curve);
      const value = (entry) => {
        if (entry === null) return "–";
        if (typeof entry === "number") return formatted(entry);
        if (typeof entry === "boolean") return entry ? "yes" : "no";
        return Array.isArray(entry) ? entry.join(" ") : typeof entry === "object" ? Object.entries(entry).map(([name, x]) => `${name} ${value(x)}`).join(", ") : entry;
      };
      const entries = Object.entries(row).filter(([name]) => !["label_reason", "command", "learning_curve"].includes(name));
      at("row").replaceChildren(...entries.flatMap(([name, entry]) => [create("dt", {}, readable(name)), create("dd", {}, name === "level_id" ? String(entry) : value(entry))]));
      const known = this.film ? `its witness reaches the goal in ${many(this.film.steps, "step")}` : "there is no witness, so this is its initial world";
      at("stage").setAttribute("aria-label", `Level ${row.level_id}, ${row.label}: ${known}. ${worldInWords(this.world)}`);
      at("stages").classList.toggle("two", Boolean(this.policy));
      at("policy").hidden = !this.policy;
      at("stage-words").hidden = !this.policy;
      if (!this.policy) return;
      const outcome = `${this.policy.solved ? "solves it" : "fails"} in ${many(this.policy.steps, "step")}`;
      at("stage-words").textContent = this.film ? `Witness: ${many(this.film.steps, "step")}` : "No witness";
      at("policy-words").textContent = `Policy: ${outcome}`;
      at("policy-stage").setAttribute("aria-label", `The policy's attempt: it ${outcome}.`);
    }

    recolour() {
      this.colours = levelproof.coloursOf();
      this.draw();
    }

    fit() {
      const fitted = ["stage", "policy-stage"].map((stage) => levelproof.fit(at(stage)));
      if (fitted.some(Boolean)) this.draw();
    }

    seek(time) {
      if (!this.steps) return;
      this.play(false);
      this.time = Math.min(this.steps, Math.max(0, time));
      this.draw();
    }

    // One step back; the rest after the last picture counts as the last picture.
    back() {
      this.seek(Math.ceil(Math.min(this.time, this.steps)) - 1);
    }

    play(playing) {
      this.playing = playing && this.steps > 0;
      at("play").textContent = this.playing ? "Pause" : "Play";
      if (!this.playing) return;
      if (this.time >= this.steps) this.time = 0;
      let before = performance.now();
      const turn = (this.turn = {}); // pausing and playing within a frame must not leave two loops
      const frame = (now) => {
        if (!this.playing || this.turn !== turn) return;
        const steps = ((now - before) / 1000 / this.columns.about.step_seconds) * Number(at("speed").value);
        before = now;
        this.time += Math.max(0, steps);
        if (this.time > this.steps + REST / this.columns.about.step_seconds) this.time = 0;
        this.draw();
        requestAnimationFrame(frame);
      };
      requestAnimationFrame(frame);
    }

    draw() {
      if (!this.world || !at("stage").clientWidth) return;
      const acting = this.show(at("stage"), this.film);
      const tried = this.policy && this.show(at("policy-stage"), this.policy);
      if (!this.steps) return;
      const time = Math.min(this.time, this.steps);
      at("scrub").value = Math.floor(time);
      const clock = `step ${Math.floor(time)} of ${this.steps} · ${(time * this.columns.about.step_seconds).toFixed(1)} s`;
      if (at("clock").textContent !== clock) at("clock").textContent = clock;
      const shown = acting || tried;
      for (const { entry, element, motor } of this.keys) {
        const words = `${entryName(entry)} ${["off", motor ? "forward" : "on", "back"][shown[entry]]}`;
        if (element.textContent !== words) {
          element.textContent = words;
          element.classList.toggle("lit", shown[entry] !== 0);
        }
      }
    }

    // Draw a film at the page's time, or the initial world; return the film's action.
    show(stage, film) {
      if (!film) {
        drawWorld(stage, this.world, this.colours);
        return null;
      }
      const { steps, states, action } = film;
      const time = Math.min(this.time, steps);
      const step = Math.min(Math.floor(time), steps - 1);
      const places = between(states[step], states[step + 1], time - step, this.now);
      const trails = at("trails").checked ? { states, until: Math.floor(time) } : null;
      drawWorld(stage, this.world, this.colours, { places, action: action(step), trails });
      return action(step);
    }

    async copy(from, button) {
      const words = at(from).textContent;
      try {
        await navigator.clipboard.writeText(words);
      } catch {
        getSelection().selectAllChildren(at(from)); // browsers may deny pages from disk the clipboard
        document.execCommand("copy");
      }
      at(button).textContent = "Copied";
      setTimeout(() => { at(button).textContent = "Copy"; }, 1500);
    }

    key(event) {
      if (this.row === null || event.ctrlKey || event.metaKey || event.altKey) return;
      const key = keyOf(event);
      if (usesKey(event.target, key)) return;
      const deeds = {
        " ": () => this.play(!this.playing),
        ArrowLeft: () => this.back(),
        ArrowRight: () => this.seek(Math.floor(this.time) + 1),
        Home: () => this.seek(0),
        End: () => this.seek(this.steps),
        Escape: () => at("back").click(),
        n: () => at("next").click(),
        p: () => at("previous").click(),
      };
      if (!deeds[key]) return;
      event.preventDefault();
      deeds[key]();
    }
  }

  // Decode an episode, of a witness or a policy; null if there is none.
  function filmOf(world, data) {
    if (!data.states) return null;
    const actions = bytesOf(data.actions);
    const steps = actions.length / ENTRIES;
    const action = (step) => actions.subarray(ENTRIES * step, ENTRIES * (step + 1));
    return { steps, action, states: statesOf(world, data.states, steps + 1) };
  }

  // Describe a world in words, for screen readers.
  function worldInWords(world) {
    const bodies = world.bodies.slice(4);
    const count = (words, total) => (total ? [`${total} ${words}${total > 1 ? "s" : ""}`] : []);
    const roles = ["green", "blue", "red", "plain"].flatMap((role) =>
      count(`${role} body`, bodies.filter((body) => body.role === role).length).map((words) => words.replace("bodys", "bodies")));
    return [...roles, ...count("joint", world.joints.length), ...count("thruster", world.thrusters.length)].join(", ");
  }

  Object.assign(window.levelproof, { LevelPage });
})();
