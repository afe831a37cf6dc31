// What the gallery and the player share besides drawing: lists that leave the keys to the page, and counts in words.
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

  // A count and its noun: "1 step", "1,024 levels".
  const many = (count, noun) => `${count.toLocaleString("en")} ${noun}${count === 1 ? "" : "s"}`;

  Object.assign(window.levelproof, { leaveAfterMouse, many });
})();
