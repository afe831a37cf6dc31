// Keeps a page's keys working after its lists were used.
"use strict";

(function () {
  // Take the focus from a list once the mouse has chosen an entry: a list with the focus takes the page's keys. If the
  // entry was chosen by keyboard, the focus stays.
  function leaveAfterMouse(list) {
    let mouse = false;
    list.addEventListener("pointerdown", () => { mouse = true; });
    list.addEventListener("keydown", () => { mouse = false; });
    list.addEventListener("change", () => { if (mouse) list.blur(); });
  }

  Object.assign(window.levelproof, { leaveAfterMouse });
})();
