"""Signatures: coarse hashes of what a picture shows, shared by levels that look nearly the same. See docs/levels.md.

Values are rounded to steps. Two levels that differ slightly may still lie on two sides of a border between steps, so
there are two hashes, of two grids half a step apart: where one has a border, the other has none.
"""

import hashlib
from typing import Any

import numpy as np

from levelproof.levelgen.identity.content import acting_joints, acting_thrusters, body_kinds, level_first
from levelproof.levelgen.level import Level
from levelproof.physics.types import MAX_VERTICES

VERSION = 1  # of the rules; signatures of different versions never compare equal
DIGITS = 16  # of each hash, hexadecimal
GRIDS = 2
POSITION = 0.5  # m, step
LENGTH = 0.2  # m, step
ANGLE = np.pi / 4  # rad, step
MAX_STEP = 2**31 - 1  # index of a step


def signatures(level: Level) -> list[list[str]]:
    """Return two hashes of each level, one per grid: `n1:` and 16 digits. Nearly equal levels mostly share one.

    They share none if values cross steps of both grids, or an angle passes a full turn. Levels with the same content
    share both: values without effect are left out here, too.
    """
    levels = level_first(level)
    return [list(both) for both in zip(*(_of_grid(levels, grid) for grid in range(GRIDS)), strict=True)]


def _of_grid(levels: Any, grid: int) -> list[str]:
    model, bodies, hashes = levels.model, _bodies(levels, grid), []
    joint_acts, thruster_acts = acting_joints(levels), acting_thrusters(levels)
    angle = _step(model.thruster_rotation, ANGLE, grid)
    for i, active in enumerate(model.active):
        row = {body: bodies[i, body].tobytes() for body in np.flatnonzero(active).tolist()}
        joints = [
            b"".join(sorted(row[int(end[i, j])] for end in (model.joint_a, model.joint_b)))
            + model.joint_fixed[i, j].tobytes()
            for j in np.flatnonzero(joint_acts[i])
        ]
        thrusters = [
            row[int(model.thruster_body[i, t])] + angle[i, t].tobytes() for t in np.flatnonzero(thruster_acts[i])
        ]
        lines = [b"%d" % grid, *sorted(row.values()), b"joints", *sorted(joints), b"thrusters", *sorted(thrusters)]
        hashes.append(f"n{VERSION}:{hashlib.sha256(b'|'.join(lines)).hexdigest()[:DIGITS]}")
    return hashes


def _bodies(levels: Any, grid: int) -> np.ndarray:
    """Return (level, body, word): kind, role, mobility, vertex count, position, angle (0 for circles), sides."""
    model, state = levels.model, levels.state
    kind = body_kinds(levels)
    used = (np.arange(MAX_VERTICES) < model.n_vertices[..., None])[..., None]
    sides = np.where(used, model.vertices, -np.inf).max(2) - np.where(used, model.vertices, np.inf).min(2)
    sides = np.concatenate([sides, np.repeat(2 * model.radius[..., None], 2, -1)], 1)
    words = [
        kind,
        levels.role,
        model.inverse_mass != 0,
        np.concatenate([model.n_vertices, np.zeros_like(model.radius)], 1),
        *np.moveaxis(_step(state.position, POSITION, grid), -1, 0),
        np.where(kind == 2, 0, _step(state.rotation, ANGLE, grid)),
        *np.moveaxis(_step(sides, LENGTH, grid), -1, 0),
    ]
    return np.ascontiguousarray(np.stack(words, -1).astype("<i4"))


def _step(values: np.ndarray, step: float, grid: int) -> np.ndarray:
    """Return the index of the step that contains each value, on one of the grids."""
    steps = np.floor(values.astype(np.float64) / step + (grid + 0.5) / GRIDS)  # so that round values lie inside a step
    return np.clip(np.nan_to_num(steps, nan=MAX_STEP), -MAX_STEP, MAX_STEP).astype("<i4")
