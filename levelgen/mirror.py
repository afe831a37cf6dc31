"""The mirror image of a level about the room's vertical middle: a symmetry of the task, up to rounding.

Actions are mirrored, too: motors turn the other way. Numpy on the host.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelproof.levelgen.level import MOTOR_BINDINGS, WORLD_SIDE, Level
from levelproof.physics.types import FIXED_POLYGONS, MAX_VERTICES, Model, State

FORWARD, BACK = 1, 2  # values of a motor's entry
LEFT_WALL, RIGHT_WALL = 1, 2  # bodies that change places


def mirror(level: Level) -> Level:
    """Mirror levels that have no contacts yet, as levels start; level axis last.

    The shapes of the scenery stay, since the faces that bodies can reach are symmetric; what is attached to one wall
    changes to the other. A motor that runs by itself gets the opposite speed; at a joint with limits it then weakens
    near the wrong one, because its control stays forward.
    """
    order = np.arange(level.size.bodies, dtype=np.int32)  # the body whose image each body becomes
    order[[LEFT_WALL, RIGHT_WALL]] = RIGHT_WALL, LEFT_WALL
    state, position = level.state, np.array(level.state.position)
    model = _mirror_model(level.model, np.asarray(level.motor_auto), order, position[:, 0])
    position[FIXED_POLYGONS:, 0] = np.float32(WORLD_SIDE) - position[FIXED_POLYGONS:, 0]
    flipped = {name: _flip(getattr(state, name)) for name in ("velocity", "joint_impulse")}
    turned = ("rotation", "angular_velocity", "joint_angular_impulse")
    negated = {name: -np.asarray(getattr(state, name)) for name in turned}
    mirrored: State = replace(state, position=position, **flipped, **negated)
    return replace(level, model=model, state=mirrored, role=np.asarray(level.role)[order])


def mirror_actions(action: Int[np.ndarray, "*batch 6"]) -> Int[np.ndarray, "*batch 6"]:
    """Swap forward and back in the entries of motors."""
    motors = action[..., :MOTOR_BINDINGS]
    swapped = np.where(motors == FORWARD, BACK, np.where(motors >= BACK, FORWARD, motors))
    return np.concatenate([swapped.astype(action.dtype), action[..., MOTOR_BINDINGS:]], -1)


def _mirror_model(
    model: Model, motor_auto: Bool[np.ndarray, "joint lane"], order: Int[np.ndarray, " body"], x: np.ndarray
) -> Model:
    """Mirror joints, thrusters, and every body's shape in its own frame; `x` [body, lane] are the bodies' positions."""
    a, b, of_thruster = (order[np.asarray(body)] for body in (model.joint_a, model.joint_b, model.thruster_body))
    shift = np.zeros_like(x)  # the scenery keeps its place, so points in its frame move
    shift[:FIXED_POLYGONS] = np.float32(WORLD_SIDE) - (x + x[order])[:FIXED_POLYGONS]

    def image(points: Float[np.ndarray | Array, "row 2 lane"], body: Int[np.ndarray, "row lane"]) -> np.ndarray:
        return _flip(points) + np.stack([np.take_along_axis(shift, body, 0), np.zeros_like(body)], 1, dtype=np.float32)

    speed = np.asarray(model.motor_speed)
    thruster = np.asarray(model.thruster_rotation)
    of_bodies = ("active", "friction", "restitution", "collision_mode")
    return replace(
        model,
        **{name: np.asarray(getattr(model, name))[order] for name in of_bodies},
        collides=np.asarray(model.collides)[order][:, order],
        gravity=_flip(model.gravity),
        vertices=_corners(np.asarray(model.vertices), np.asarray(model.n_vertices)),
        joint_a=a,
        joint_b=b,
        joint_anchor_a=image(model.joint_anchor_a, a),
        joint_anchor_b=image(model.joint_anchor_b, b),
        joint_rotation=-np.asarray(model.joint_rotation),
        joint_min=-np.asarray(model.joint_max),
        joint_max=-np.asarray(model.joint_min),
        motor_speed=np.where(motor_auto, -speed, speed),
        thruster_body=of_thruster,
        thruster_position=image(model.thruster_position, of_thruster),
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
