// Learning curve: success rate of training per update, null if no episode ended.
"use strict";

(function () {
  const [LEFT, RIGHT, TOP, BOTTOM] = [30, 314, 8, 102]; // within the view box 0 0 320 120
  const MAX_DOTS = 60; // with more points, only the line is drawn

  // Draw rates into an <svg> in a <figure>; hide the figure if there is no curve.
  function drawCurve(svg, rates) {
    const known = rates.map((rate, update) => [update, rate]).filter(([, rate]) => rate !== null);
    const figure = svg.closest("figure");
    figure.hidden = !known.length || rates.length < 2;
    if (figure.hidden) return;
    const x = (update) => (LEFT + ((RIGHT - LEFT) * update) / (rates.length - 1)).toFixed(1);
    const y = (rate) => (BOTTOM - (BOTTOM - TOP) * rate).toFixed(1);
    const text = (words, x, y, anchor) => `<text x="${x}" y="${y}" text-anchor="${anchor}">${words}</text>`;
    const grid = [0, 0.5, 1].map((rate) => `<line x1="${LEFT}" x2="${RIGHT}" y1="${y(rate)}" y2="${y(rate)}"/>${text(`${100 * rate}%`, LEFT - 5, Number(y(rate)) + 3, "end")}`);
    const path = known.map(([update, rate], i) => `${i ? "L" : "M"}${x(update)} ${y(rate)}`);
    const dots = known.length > MAX_DOTS ? [] : known.map(([update, rate]) => `<circle cx="${x(update)}" cy="${y(rate)}" r="2"/>`);
    svg.innerHTML = [...grid, `<path d="${path.join("")}"/>`, ...dots, text("update 1", LEFT, 115, "start"), text(rates.length, RIGHT, 115, "end")].join("");
    const words = `Share of training episodes that reached the goal, in each of ${rates.length} updates`;
    const [first, last] = [known[0], known[known.length - 1]].map(([, rate]) => `${Math.round(100 * rate)}%`);
    svg.setAttribute("aria-label", `${words}: from ${first} to ${last}`);
    figure.querySelector("figcaption").textContent = `${words}.`;
  }

  Object.assign(window.levelproof, { drawCurve });
})();
