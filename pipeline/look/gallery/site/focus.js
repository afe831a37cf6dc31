// What the gallery and the player share besides drawing: making elements, keys that the page has a use for, lists that
// leave them to the page, and counts in words.
"use strict";

(function () {
  const SVG = "http://www.w3.org/2000/svg";

  // Make an element with attributes, listeners (attributes that are functions) and what is inside it.
  function create(tag, attributes = {}, ...inside) {
    const element = attributes.svg ? document.createElementNS(SVG, tag) : document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) {
      if (name === "svg" || value === undefined) continue;
      if (typeof value === "function") element.addEventListener(name, value);
      else element.setAttribute(name, value);
    }
    element.append(...inside);
    return element;
  }

  // What a key means on any keyboard: its letter in lower case. If it has none, what an American keyboard has in its
  // place: a letter if the keyboard has others, as Russian ones do, or a digit, which on French ones needs Shift.
  function keyOf({ key = "", code = "" }) {
    if (key.length > 1) return key;
    const place = /[a-z0-9 ]/i.test(key) ? null : code.match(/^[\x20-\x7e]/.test(key) ? /^Digit(.)$/ : /^(?:Key|Digit)(.)$/);
    return (place ? place[1] : key).toLowerCase();
  }

  // Whether an element with the focus has a use of its own for a key: buttons are pressed, words are typed.
  function usesKey({ tagName, type }, key) {
    if (tagName === "SELECT" || (tagName === "INPUT" && !/^(checkbox|file|range)$/.test(type))) return key !== "Escape";
    return (/^(BUTTON|A)$/.test(tagName) || /^(checkbox|file)$/.test(type)) && (key === " " || key === "Enter");
  }

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

  Object.assign(window.levelproof, { create, keyOf, usesKey, leaveAfterMouse, many });
})();
