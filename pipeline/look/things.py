"""Counts of the entities in levels, without the scenery."""

import numpy as np
from jaxtyping import Int

from levelproof.levelgen.level import Level
from levelproof.physics.types import FIXED_POLYGONS

ENTITIES = ("bodies", "joints", "motors", "thrusters")


def count_entities(level: Level) -> dict[str, Int[np.ndarray, " level"]]:
    """Count each level's bodies (without scenery), joints (fixed ones too), motors that are on, and thrusters."""
    model = level.model
    joints, motors = np.asarray(model.joint_active), np.asarray(model.motor_on) & ~np.asarray(model.joint_fixed)
    bodies, thrusters = np.asarray(model.active)[FIXED_POLYGONS:], np.asarray(model.thruster_active)
    counts = (x.sum(0, dtype=np.int32) for x in (bodies, joints, joints & motors, thrusters))
    return dict(zip(ENTITIES, counts, strict=True))
