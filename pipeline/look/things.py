"""How many things levels have: what their worlds are made of, beside the scenery."""

import numpy as np
from jaxtyping import Int

from levelproof.levelgen.level import Level
from levelproof.physics.types import FIXED_POLYGONS

THINGS = ("bodies", "joints", "motors", "thrusters")


def things_of(level: Level) -> dict[str, Int[np.ndarray, " level"]]:
    """How many of THINGS each level has: bodies without the scenery's, joints that turn or not, motors that are on."""
    model = level.model
    joints, motors = np.asarray(model.joint_active), np.asarray(model.motor_on) & ~np.asarray(model.joint_fixed)
    bodies, thrusters = np.asarray(model.active)[FIXED_POLYGONS:], np.asarray(model.thruster_active)
    counts = (x.sum(0, dtype=np.int32) for x in (bodies, joints, joints & motors, thrusters))
    return dict(zip(THINGS, counts, strict=True))
