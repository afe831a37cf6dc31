// Draws a world on a canvas like levelgen/pictures/scene.py: bodies by role, immovable ones hatched; a ring is a
// revolute joint, a crossed square a fixed one; a motor's ring has its binding's colour, and an arrow while it runs; a
// thruster is a nozzle, with a flame while it fires.
//
// Knows nothing of where worlds come from. Lengths in metres, y up, angles in radians; colours from palette.css. A
// world is {still, bodies, joints, thrusters, start}; its first `still` bodies are immovable. Places are x, y, angle of
// one body after the other. An action is six numbers: 4 motors (0 off, 1 forward, 2 back), 2 thrusters (0 off, 1 on).
"use strict";
window.levelproof = window.levelproof || {};

(function () {
  const SIDE = 5; // m; side of the world
  const BORDER = 0.08; // m; visible part of the walls
  const VIEW = SIDE + 2 * BORDER; // m; side of the square picture
  const PIXELS = 1200; // maximum side of a canvas
  const EDGE = 0.022; // m; width of an outline
  const LENGTH = 1 / 2000; // m; unit of encoded lengths
  const ANGLE = 1 / 10000; // rad; unit of encoded angles
  const MOTORS = 4; // first entries of an action; thrusters follow
  const ROLES = ["plain", "green", "blue", "red"];
  const NOZZLE = [[0.06, 0.045], [0.06, -0.045], [-0.12, -0.1], [-0.12, 0.1]];
  const FLAMES = [1.0, 0.6]; // relative lengths of a flame's tongues
  const TURN = 2 * Math.PI;

  // Decode base64.
  function bytesOf(text) {
    const letters = atob(text);
    const bytes = new Uint8Array(letters.length);
    for (let i = 0; i < letters.length; i++) bytes[i] = letters.charCodeAt(i);
    return bytes;
  }

  // Decode a world (pipeline/look/gallery/worlds.py).
  function worldOf(text) {
    const numbers = new Int16Array(bytesOf(text).buffer);
    let at = 0;
    const next = () => numbers[at++];
    const point = () => [next() * LENGTH, next() * LENGTH];
    const [count, still, jointCount, thrusterCount] = [next(), next(), next(), next()];
    const start = new Float32Array(3 * count);
    const bodies = [], joints = [], thrusters = [];
    for (let body = 0; body < count; body++) {
      const role = ROLES[next()] || ROLES[0];
      const corners = next();
      start.set([...point(), next() * ANGLE], 3 * body);
      bodies.push(corners ? { role, corners: Array.from({ length: corners }, point) } : { role, radius: next() * LENGTH });
    }
    for (let i = 0; i < jointCount; i++) {
      const [body, anchor, kind, binding] = [next(), point(), next(), next()];
      joints.push({ body, anchor, fixed: Boolean(kind & 1), motor: kind & 2 && !(kind & 1), auto: kind & 4, reversed: kind & 8, binding });
    }
    for (let i = 0; i < thrusterCount; i++) {
      thrusters.push({ body: next(), position: point(), angle: next() * ANGLE, binding: MOTORS + next() });
    }
    return {
      still, start, bodies,
      joints: joints.filter((joint) => joint.body < count),
      thrusters: thrusters.filter((thruster) => thruster.body < count),
    };
  }

  // Decode the places of all bodies at each time; only movable bodies are stored.
  function statesOf(world, text, times) {
    const numbers = new Int16Array(bytesOf(text).buffer);
    const moving = 3 * (world.bodies.length - world.still);
    return Array.from({ length: times }, (_, time) => {
      const places = world.start.slice();
      for (let i = 0; i < moving; i++) {
        places[3 * world.still + i] = numbers[time * moving + i] * (i % 3 === 2 ? ANGLE : LENGTH);
      }
      return places;
    });
  }

  // Interpolate places between two times; `part` is from 0 to 1. Angles turn the shorter way.
  function between(before, after, part, into) {
    for (let i = 0; i < before.length; i++) {
      let step = after[i] - before[i];
      if (i % 3 === 2) step -= TURN * Math.round(step / TURN);
      into[i] = before[i] + part * step;
    }
    return into;
  }

  // Entries of an action that a motor or thruster obeys.
  function liveEntries(world) {
    const motors = world.joints.filter((joint) => joint.motor && !joint.auto).map((joint) => joint.binding);
    return [...new Set([...motors, ...world.thrusters.map((thruster) => thruster.binding)])].sort((a, b) => a - b);
  }

  function entryName(entry) {
    return entry < MOTORS ? `M${entry + 1}` : `T${entry - MOTORS + 1}`;
  }

  function shaded(colour, factor) {
    const parts = colour.match(/\d+/g).slice(0, 3);
    return `rgb(${parts.map((part) => Math.round(part * factor)).join(",")})`;
  }

  // The page's current colours, light or dark.
  function coloursOf(element = document.documentElement) {
    const style = getComputedStyle(element);
    const named = (name) => style.getPropertyValue(`--${name}`).trim();
    const colours = { bindings: [0, 1, 2, 3, 4, 5].map((entry) => named(`binding-${entry}`)) };
    for (const name of ["sky", "grid", "ink", "paper", "muted", "fixed", ...ROLES]) colours[name] = named(name);
    colours.flames = FLAMES.map((_, tongue) => named(`flame-${tongue}`));
    colours.moving = Object.fromEntries(ROLES.map((role) => [role, colours[role]]));
    colours.still = Object.fromEntries(ROLES.map((role) => [role, role === "plain" ? colours.fixed : shaded(colours[role], 0.72)]));
    colours.edge = {};
    for (const colour of [...Object.values(colours.moving), ...Object.values(colours.still)]) {
      colours.edge[colour] = shaded(colour, 0.62);
    }
    return colours;
  }

  let hatching = null;

  // Pattern of diagonal lines for immovable bodies.
  function hatch(context) {
    if (!hatching) {
      const tile = document.createElement("canvas");
      tile.width = tile.height = 32;
      const lines = tile.getContext("2d");
      lines.strokeStyle = "rgba(0,0,0,0.34)";
      lines.lineWidth = 7;
      for (const from of [-32, 0, 32]) {
        lines.beginPath();
        lines.moveTo(from - 4, -4);
        lines.lineTo(from + 36, 36);
        lines.stroke();
      }
      hatching = context.createPattern(tile, "repeat");
      hatching.setTransform(new DOMMatrix().scale(0.1 / 32)); // a line every 0.1 m
    }
    return hatching;
  }

  function outline(context, points) {
    context.beginPath();
    for (const [x, y] of points) context.lineTo(x, y);
    context.closePath();
  }

  function disc(context, x, y, radius, fill, edge, width = EDGE) {
    context.beginPath();
    context.arc(x, y, radius - width / 2, 0, TURN);
    context.fillStyle = fill;
    context.fill();
    context.strokeStyle = edge;
    context.lineWidth = width;
    context.stroke();
  }

  function drawBody(context, body, isStill, x, y, angle, colours) {
    const fill = (isStill ? colours.still : colours.moving)[body.role];
    context.save();
    context.translate(x, y);
    context.rotate(angle);
    if (body.corners) outline(context, body.corners);
    else {
      context.beginPath();
      context.arc(0, 0, Math.max(0, body.radius - EDGE / 2), 0, TURN);
    }
    context.fillStyle = fill;
    context.fill();
    if (isStill) {
      context.fillStyle = hatch(context);
      context.fill();
    }
    context.strokeStyle = colours.edge[fill];
    context.lineWidth = EDGE;
    context.stroke();
    if (!body.corners) {
      context.beginPath();
      context.moveTo(0, 0);
      context.lineTo(body.radius, 0);
      context.stroke();
    }
    context.restore();
  }

  // World coordinates of a point in a body's frame.
  function attached(places, body, [x, y]) {
    const [cos, sin] = [Math.cos(places[3 * body + 2]), Math.sin(places[3 * body + 2])];
    return [places[3 * body] + x * cos - y * sin, places[3 * body + 1] + x * sin + y * cos];
  }

  function drawThruster(context, thruster, places, fires, colours) {
    const [x, y] = attached(places, thruster.body, thruster.position);
    context.save();
    context.translate(x, y);
    context.rotate(thruster.angle + places[3 * thruster.body + 2]);
    if (fires) {
      FLAMES.forEach((length, tongue) => {
        const half = 0.075 * (0.5 + length / 2);
        const [waist, tip] = [-0.1 - 0.16 * length, -0.1 - 0.34 * length];
        outline(context, [[-0.1, half], [waist, half * 0.8], [tip, 0], [waist, -half * 0.8], [-0.1, -half]]);
        context.fillStyle = colours.flames[tongue];
        context.fill();
      });
    }
    outline(context, NOZZLE);
    context.fillStyle = colours.bindings[thruster.binding];
    context.fill();
    context.strokeStyle = colours.ink;
    context.lineWidth = EDGE;
    context.stroke();
    context.restore();
  }

  // 1: the motor turns body b counterclockwise relative to body a; -1: clockwise; 0: off.
  function turnOf(joint, action) {
    if (!action || !joint.motor) return 0;
    const forward = joint.reversed ? -1 : 1;
    return [0, forward, -forward][joint.auto ? 1 : action[joint.binding]] || 0;
  }

  function drawJoint(context, joint, places, action, colours) {
    const [x, y] = attached(places, joint.body, joint.anchor);
    context.save();
    context.translate(x, y);
    if (joint.fixed) {
      const r = 0.065;
      outline(context, [[-r, -r], [r, -r], [r, r], [-r, r]]);
      context.fillStyle = colours.paper;
      context.fill();
      context.moveTo(-r, -r);
      context.lineTo(r, r);
      context.moveTo(-r, r);
      context.lineTo(r, -r);
      context.strokeStyle = colours.ink;
      context.lineWidth = EDGE;
      context.stroke();
    } else {
      const colour = joint.motor ? colours.bindings[joint.binding] : colours.paper;
      disc(context, 0, 0, joint.motor ? 0.085 : 0.07, colour, colours.ink);
      disc(context, 0, 0, 0.025, joint.motor && joint.auto ? colours.ink : colours.paper, colours.ink);
      drawArrow(context, turnOf(joint, action), colour, colours);
    }
    context.restore();
  }

  // Three quarters of a circle around a joint, with an arrow head at its end.
  function drawArrow(context, turn, colour, colours) {
    if (!turn) return;
    const radius = 0.17;
    const [from, to] = turn > 0 ? [TURN / 8, (7 * TURN) / 8] : [(7 * TURN) / 8, TURN / 8];
    for (const [width, paint] of [[0.035 + EDGE, colours.ink], [0.035, colour]]) {
      context.beginPath();
      context.arc(0, 0, radius, from, to, turn < 0);
      context.strokeStyle = paint;
      context.lineWidth = width;
      context.stroke();
    }
    const [cos, sin] = [Math.cos(to), Math.sin(to)];
    const [x, y] = [radius * cos, radius * sin];
    outline(context, [[x - turn * 0.12 * sin, y + turn * 0.12 * cos], [x + 0.07 * cos, y + 0.07 * sin], [x - 0.07 * cos, y - 0.07 * sin]]);
    context.fillStyle = colour;
    context.fill();
    context.strokeStyle = colours.ink;
    context.lineWidth = 0.014;
    context.stroke();
  }

  // Draw the path of each movable body, in its role's colour.
  function drawTrails(context, world, states, until, colours) {
    context.lineWidth = 0.02;
    context.globalAlpha = 0.55;
    for (let body = world.still; body < world.bodies.length; body++) {
      context.beginPath();
      for (let time = 0; time <= until; time++) context.lineTo(states[time][3 * body], states[time][3 * body + 1]);
      context.strokeStyle = colours.moving[world.bodies[body].role];
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  // Draw the whole world on a square canvas. `now`: {places, action, trails: {states, until}}, each optional.
  function drawWorld(canvas, world, colours, now = {}) {
    const context = canvas.getContext("2d");
    const places = now.places || world.start;
    const scale = canvas.width / VIEW;
    context.setTransform(scale, 0, 0, -scale, BORDER * scale, (SIDE + BORDER) * scale);
    context.lineJoin = "round";
    context.fillStyle = colours.fixed;
    context.fillRect(-BORDER, -BORDER, VIEW, VIEW);
    context.fillStyle = colours.sky;
    context.fillRect(0, 0, SIDE, SIDE);
    context.fillStyle = colours.grid;
    for (let metre = 1; metre < SIDE; metre++) {
      context.fillRect(metre - 0.005, 0, 0.01, SIDE);
      context.fillRect(0, metre - 0.005, SIDE, 0.01);
    }
    world.bodies.forEach((body, i) => {
      if (i === world.still && now.trails) drawTrails(context, world, now.trails.states, now.trails.until, colours);
      drawBody(context, body, i < world.still, places[3 * i], places[3 * i + 1], places[3 * i + 2], colours);
    });
    for (const thruster of world.thrusters) {
      drawThruster(context, thruster, places, now.action && now.action[thruster.binding], colours);
    }
    for (const joint of world.joints) drawJoint(context, joint, places, now.action, colours);
  }

  // Match a canvas's resolution to its size on screen; return whether it is visible.
  function fit(canvas) {
    const pixels = Math.min(PIXELS, Math.round(canvas.clientWidth * devicePixelRatio));
    if (pixels && canvas.width !== pixels) canvas.width = canvas.height = pixels;
    return pixels > 0;
  }

  // Position of a pointer in the world that a canvas shows, m.
  function metresOf(canvas, event) {
    const box = canvas.getBoundingClientRect();
    const scale = VIEW / box.width;
    return [(event.clientX - box.left) * scale - BORDER, SIDE + BORDER - (event.clientY - box.top) * scale];
  }

  Object.assign(window.levelproof, {
    bytesOf, worldOf, statesOf, between, liveEntries, entryName, coloursOf, attached, drawWorld, fit, metresOf,
  });
})();
