// Entry point: connects the parts of the page.
"use strict";

(function () {
  const { Link, Stage, Player, Editor, Expert } = window.levelproof;
  const MAX_BYTES = 4e6; // of a level file; the server closes the connection at twice as many
  const at = (id) => document.getElementById(id);
  const stage = new Stage(at("stage"));
  const link = new Link((message) => expert.update(message));

  // Show a new or changed level in every part.
  function opened(level) {
    stage.open(level);
    player.open(level);
    editor.open(level);
    expert.open();
  }

  const player = new Player(link, stage);
  const editor = new Editor(link, stage, opened, () => player.rewind());
  const expert = new Expert(link, stage, (film) => {
    at("watch").disabled = at("save-witness").disabled = false;
    player.film(film);
  });

  async function open(name, fields) {
    try {
      opened(await link.ask(name, fields));
      levelproof.problem("");
    } catch (error) {
      levelproof.problem(error.message);
    }
  }

  async function save(witness) {
    try {
      const { document: level } = await link.ask("save");
      if (!witness) delete level.witness;
      const anchor = Object.assign(document.createElement("a"), {
        href: URL.createObjectURL(new Blob([JSON.stringify(level)], { type: "application/json" })),
        download: witness ? "witness.json" : "level.json",
      });
      anchor.click();
      setTimeout(() => URL.revokeObjectURL(anchor.href), 10000);
    } catch (error) {
      levelproof.problem(error.message);
    }
  }

  at("open").addEventListener("change", async (event) => {
    const [file] = event.target.files;
    if (!file) return;
    const refuse = (reason) => levelproof.problem(`Cannot use the level file ${file.name}: ${reason}.`);
    event.target.blur(); // else Space opens another file
    if (file.size > MAX_BYTES) { // a much larger one would close the connection without a message
      refuse(`it has ${file.size.toLocaleString("en")} bytes, but no level needs more than ${MAX_BYTES.toLocaleString("en")}`);
      event.target.value = "";
      return;
    }
    try {
      await open("load", { name: file.name, document: JSON.parse(await file.text()) });
    } catch {
      refuse("it is not JSON");
    }
    event.target.value = "";
  });
  at("new").addEventListener("click", () => { // a list alone would open another level with each arrow key
    at("new").blur();
    open("empty", { size: at("new-size").value });
  });
  levelproof.leaveAfterMouse(at("new-size"));
  at("save").addEventListener("click", () => save(false));
  at("save-witness").addEventListener("click", () => save(true));

  link.ask("level").then((level) => {
    at("new-size").replaceChildren(...level.sizes.map((size) => new Option(`size ${size}`, size)));
    if (level.sizes.includes(level.size)) at("new-size").value = level.size;
    opened(level);
  }).catch((error) => levelproof.problem(error.message));
})();
