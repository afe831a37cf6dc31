// The websocket to the engine: questions with answers, and what is told without a question.
"use strict";

(function () {
  class Link {
    constructor(told) {
      this.waiting = new Map();
      this.asked = 0;
      this.socket = new WebSocket(`ws://${location.host}/socket`);
      this.ready = new Promise((resolve, reject) => {
        this.socket.addEventListener("open", resolve);
        this.socket.addEventListener("error", () => reject(new Error("The engine cannot be reached.")));
      });
      this.socket.addEventListener("close", () => {
        const gone = new Error("The engine has ended: run `levelproof play` again and reload this page.");
        for (const { reject } of this.waiting.values()) reject(gone);
        this.waiting.clear();
        levelproof.problem(gone.message);
      });
      this.socket.addEventListener("message", (event) => {
        const message = JSON.parse(event.data);
        if (message.training) return told(message.training);
        const waiting = this.waiting.get(message.id);
        this.waiting.delete(message.id);
        if (message.error) waiting.reject(new Error(message.error));
        else waiting.resolve(message);
      });
    }

    // The answer to a question; an Error with a sentence where there is none.
    async ask(name, words = {}) {
      await this.ready;
      const id = ++this.asked;
      this.socket.send(JSON.stringify({ ask: name, id, ...words }));
      return new Promise((resolve, reject) => this.waiting.set(id, { resolve, reject }));
    }
  }

  levelproof.problem = (words) => {
    document.getElementById("problem").textContent = words;
  };
  levelproof.Link = Link;
})();
