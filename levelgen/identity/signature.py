"""Which levels look nearly the same: a coarse hash of what a picture shows. docs/levels.md.

Two levels that differ by little may still lie on two sides of a border between steps. So there are two hashes, of two
grids half a step apart: where one has a border, the other has none.
"""

import hashlib
from typing import Any

import numpy as np

from levelproof.levelgen.identity.content import acting_joints, acting_thrusters, kinds, level_first
from levelproof.levelgen.level import Level
from levelproof.physics.types import MAX_VERTICES

VERSION = 1  # of the rules; signatures of different versions never compare equal
DIGITS = 16  # of each hash, hexadecimal
GRIDS = 2
POSITION = 0.5  # m; steps that are told apart
LENGTH = 0.2  # m
ANGLE = np.pi / 4  # rad
FARTHEST = 2**31 - 1  # steps


def signatures(level: Level) -> list[list[str]]:
    """Of each level one hash for each grid, such as `n1:` and 16 digits. Nearly the same levels share one of them.

    Levels of the same content share both: what has no effect is left out here as well.
    """
    levels = level_first(level)
    return [list(both) for both in zip(*(_of_grid(levels, grid) for grid in range(GRIDS)), strict=True)]


def _of_grid(levels: Any, grid: int) -> list[str]:
    model, bodies, found = levels.model, _bodies(levels, grid), []
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
        found.append(f"n{VERSION}:{hashlib.sha256(b'|'.join(lines)).hexdigest()[:DIGITS]}")
    return found


def _bodies(levels: Any, grid: int) -> np.ndarray:
    """(level, body, word): kind, role, whether it can move, position, sides; a circle looks the same at every angle."""
    model, state = levels.model, levels.state
    kind = kinds(levels)
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
    """The number of the step that a value lies in, on one of the grids."""
    steps = np.floor(values.astype(np.float64) / step + (grid + 0.5) / GRIDS)  # round numbers lie between borders
    return np.clip(np.nan_to_num(steps, nan=FARTHEST), -FARTHEST, FARTHEST).astype("<i4")
