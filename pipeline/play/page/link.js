// The websocket to the server: requests with answers, and progress of training without a request.
"use strict";

(function () {
  const STOPPED = "The engine has stopped: run `levelproof play` again and reload this page.";

  class Link {
    constructor(progress) {
      this.waiting = new Map();
      this.requests = 0;
      this.socket = new WebSocket(`ws://${location.host}/socket`);
      this.ready = new Promise((resolve, reject) => {
        this.socket.addEventListener("open", resolve);
        this.socket.addEventListener("error", () => reject(new Error("Cannot reach the engine.")));
      });
      this.socket.addEventListener("close", () => {
        for (const { reject } of this.waiting.values()) reject(new Error(STOPPED));
        this.waiting.clear();
        levelproof.problem(STOPPED);
      });
      this.socket.addEventListener("message", (event) => {
        const message = JSON.parse(event.data);
        if (message.training) return progress(message.training);
        const waiting = this.waiting.get(message.id);
        this.waiting.delete(message.id);
        if (message.error) waiting.reject(new Error(message.error));
        else waiting.resolve(message);
      });
    }

    // Send a request and return its answer; throw an Error if the server reports one.
    async ask(name, fields = {}) {
      await this.ready;
      if (this.socket.readyState !== WebSocket.OPEN) throw new Error(STOPPED);
      const id = ++this.requests;
      this.socket.send(JSON.stringify({ ask: name, id, ...fields }));
      return new Promise((resolve, reject) => this.waiting.set(id, { resolve, reject }));
    }
  }

  levelproof.problem = (words) => {
    document.getElementById("problem").textContent = words;
  };
  levelproof.Link = Link;
})();
