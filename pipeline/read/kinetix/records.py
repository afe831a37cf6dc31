"""Conversion of levels and records to the reference's disk layout: a structured array (trajectory, time).

Each field has an extra leading axis of length 1, which the reference's reader drops.
"""

from functools import cache
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.witness.witness import Record
from levelproof.levelgen.batching import merge_steps
from levelproof.levelgen.files.kinetix import (
    BODIES,
    MANIFOLD,
    MANIFOLDS,
    MODEL,
    STATE,
    TASK,
    Fields,
    fillers,
    level_to_kinetix,
    to_kinetix,
)
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.actions import action_mask
from levelproof.physics.types import Size
from levelproof.pipeline.store.contents import none_of

T = TypeVar("T")

WORLD = "env_state/"  # prefix of the reference's state fields
# Fields of the first state that make up a level
LEVEL_FIELDS = tuple(
    dict.fromkeys(
        name.replace("*", body).replace("@", manifold)
        for name in ("timestep", *MODEL.values(), *STATE.values(), *TASK.values())
        for body in BODIES
        for manifold in MANIFOLDS
    )
)
# m, position of inactive joints and thrusters at an episode's start, in the reference. Later an inactive joint is at 0,
# an inactive thruster where an active one would be
INACTIVE_POSITION = {"joint": np.float32(256), "thruster": np.float32(0)}
RECORD_FIELDS = {
    "joint_point": f"{WORLD}joint/global_position",
    "thruster_point": f"{WORLD}thruster/global_position",
    "timestep": f"{WORLD}timestep",
    "last_distance": f"{WORLD}last_distance",
    "action": "action",
    "done": "done",
}


def fields_of(level: Level, record: Record) -> Fields:
    """Return the 85 fields of trajectories: (trajectory, 256, ...), or (trajectory, 1, ...) if constant in a level.

    Args:
        level: levels, level axis last.
        record: one record per level; time first, level last.
    """
    size, count = level.size, record.done.shape[-1]
    state, manifold = (merge_steps(jax.tree.map(np.asarray, tree)) for tree in (record.state, record.manifold))
    moving = to_kinetix(size, state, STATE) | to_kinetix(size, manifold, MANIFOLD)
    moving = {
        f"{WORLD}{name}": values.reshape(count, RECORD_STEPS, *values.shape[1:]) for name, values in moving.items()
    }
    moving |= {theirs: np.moveaxis(np.asarray(getattr(record, ours)), -1, 0) for ours, theirs in RECORD_FIELDS.items()}
    for kind, at_start in INACTIVE_POSITION.items():
        unused = ~np.asarray(getattr(level.model, f"{kind}_active")).T[:, None, :, None]
        points, start = moving[f"{WORLD}{kind}/global_position"], moving[f"{WORLD}timestep"][..., None, None] == 0
        later = np.float32(0) if kind == "joint" else points
        moving[f"{WORLD}{kind}/global_position"] = np.where(unused, np.where(start, at_start, later), points)
    still = level_to_kinetix(level) | fillers(level)
    still |= {
        "polygon_highlighted": np.zeros((count, size.polygons), bool),  # set by the reference's editor only
        "circle_highlighted": np.zeros((count, size.circles), bool),
    }
    mask = np.asarray(action_mask(jax.tree.map(jnp.asarray, level))).T
    fixed = {f"{WORLD}{name}": values for name, values in still.items()} | {"action_mask": mask}
    return moving | {name: values[:, None] for name, values in fixed.items()}


def trajectories_of(level: Level, record: Record) -> np.ndarray:
    """Pack `fields_of` levels and records into one array (trajectory, 256) of dtype `dtype_of(level.size)`."""
    fields = fields_of(level, record)
    made = np.zeros((len(fields["done"]), RECORD_STEPS), dtype_of(level.size))
    for name, values in fields.items():
        made[name][:, :, 0] = values
    return made


@cache
def dtype_of(size: Size) -> np.dtype:
    """Return the dtype of one step of a trajectory."""
    fields = fields_of(*none_of(size))
    return np.dtype([(name, fields[name].dtype, (1, *fields[name].shape[2:])) for name in sorted(fields)])
