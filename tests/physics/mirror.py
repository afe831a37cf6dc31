"""The mirror image of a world: x becomes -x, rotations change sign."""

import dataclasses

import jax
import numpy as np

from levelproof.physics.types import MAX_VERTICES, Manifold, Model, State


def _flip(x, axis: int = -2) -> np.ndarray:
    """Negate the x of vectors [..., 2, lane]."""
    x = np.asarray(x)
    sign = np.array([-1, 1], x.dtype).reshape([2 if i == x.ndim + axis else 1 for i in range(x.ndim)])
    return x * sign


def _corners(vertices, n_vertices) -> np.ndarray:
    """Mirror vertices [polygon, vertex, 2, lane]; reverse their order to stay clockwise. Unused ones stay last."""
    flipped = _flip(vertices)
    index, count = np.arange(MAX_VERTICES)[:, None, None], np.asarray(n_vertices)[:, None, None]
    source = np.where(index < count, count - 1 - index, index)  # [polygon, vertex, 1, lane]
    source = np.broadcast_to(source, flipped.shape)
    return np.take_along_axis(flipped, source, axis=1)


def of_model(model: Model) -> Model:
    """Mirror a model: thrusters point the other way along x; a joint's limits are swapped."""
    return dataclasses.replace(
        model,
        gravity=_flip(model.gravity),
        vertices=_corners(model.vertices, model.n_vertices),
        joint_anchor_a=_flip(model.joint_anchor_a),
        joint_anchor_b=_flip(model.joint_anchor_b),
        joint_rotation=-np.asarray(model.joint_rotation),
        joint_min=-np.asarray(model.joint_max),
        joint_max=-np.asarray(model.joint_min),
        thruster_position=_flip(model.thruster_position),
        thruster_rotation=(np.pi - np.asarray(model.thruster_rotation)).astype(model.thruster_rotation.dtype),
    )


def of_state(state: State) -> State:
    """Mirror a state. A contact's tangent is its normal turned clockwise by 90 degrees, so its impulse changes sign."""
    negated = ("rotation", "angular_velocity", "contact_tangent_impulse", "joint_angular_impulse")
    vectors = ("position", "velocity", "joint_impulse")
    return dataclasses.replace(
        state,
        **{name: -np.asarray(getattr(state, name)) for name in negated},
        **{name: _flip(getattr(state, name)) for name in vectors},
    )


def of_manifold(manifold: Manifold) -> Manifold:
    return dataclasses.replace(manifold, normal=_flip(manifold.normal), point=_flip(manifold.point))


def of_world(model, state, motor, thrust):
    """Mirror a world with its controls: motors are driven the other way."""
    return jax.tree.map(np.asarray, (of_model(model), of_state(state), -np.asarray(motor), thrust))
