"""The mirror image of a level about the room's vertical middle: a symmetry of the task, up to rounding.

Actions are mirrored, too: motors turn the other way. Numpy on the host.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelproof.levelgen.level import MOTOR_BINDINGS, WORLD_SIDE, Level
from levelproof.physics.types import FIXED_POLYGONS, MAX_VERTICES, Model, State

FORWARD, BACK = 1, 2  # values of a motor's entry


def mirror(level: Level) -> Level:
    """Mirror levels that have no contacts yet, as levels start; level axis last.

    The scenery stays, since the faces that bodies can reach are symmetric. A motor that runs by itself gets the
    opposite speed.
    """
    model, state = _mirror_model(level.model, np.asarray(level.motor_auto)), level.state
    x = np.asarray(state.position)[FIXED_POLYGONS:, 0]
    position = np.array(state.position)
    position[FIXED_POLYGONS:, 0] = np.float32(WORLD_SIDE) - x
    moved = {"velocity": _flip(state.velocity), "position": position}
    turned = {name: -np.asarray(getattr(state, name)) for name in ("rotation", "angular_velocity")}
    mirrored: State = replace(state, **moved, **turned)
    return replace(level, model=model, state=mirrored)


def mirror_actions(action: Int[np.ndarray, "*batch 6"]) -> Int[np.ndarray, "*batch 6"]:
    """Swap forward and back in the entries of motors."""
    motors = action[..., :MOTOR_BINDINGS]
    swapped = np.where(motors == FORWARD, BACK, np.where(motors >= BACK, FORWARD, motors))
    return np.concatenate([swapped.astype(action.dtype), action[..., MOTOR_BINDINGS:]], -1)


def _mirror_model(model: Model, motor_auto: Bool[np.ndarray, "joint lane"]) -> Model:
    """Mirror joints, thrusters, and every body's shape in its own frame."""
    speed = np.asarray(model.motor_speed)
    thruster = np.asarray(model.thruster_rotation)
    return replace(
        model,
        gravity=_flip(model.gravity),
        vertices=_corners(np.asarray(model.vertices), np.asarray(model.n_vertices)),
        joint_anchor_a=_flip(model.joint_anchor_a),
        joint_anchor_b=_flip(model.joint_anchor_b),
        joint_rotation=-np.asarray(model.joint_rotation),
        joint_min=-np.asarray(model.joint_max),
        joint_max=-np.asarray(model.joint_min),
        motor_speed=np.where(motor_auto, -speed, speed),
        thruster_position=_flip(model.thruster_position),
        thruster_rotation=(np.pi - thruster).astype(thruster.dtype),
    )


def _flip(vectors: Float[np.ndarray | Array, "*points 2 lane"]) -> Float[np.ndarray, "*points 2 lane"]:
    """Negate x."""
    return np.asarray(vectors) * np.array([[-1], [1]], np.float32)


def _corners(
    vertices: Float[np.ndarray, "polygon vertex 2 lane"], n_vertices: Int[np.ndarray, "polygon lane"]
) -> Float[np.ndarray, "polygon vertex 2 lane"]:
    """Mirror all polygons but the scenery; reverse their corners, which stay clockwise. Unused corners stay last."""
    index, count = np.arange(MAX_VERTICES)[:, None, None], n_vertices[:, None, None]
    source = np.broadcast_to(np.where(index < count, count - 1 - index, index), vertices.shape)
    mirrored = np.take_along_axis(_flip(vertices), source, axis=1)
    return np.concatenate([vertices[:FIXED_POLYGONS], mirrored[FIXED_POLYGONS:]])
