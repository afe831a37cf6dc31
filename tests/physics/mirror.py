"""The same world seen in a mirror: x becomes -x, turns go the other way."""

import dataclasses

import jax
import numpy as np

from levelproof.physics.types import MAX_VERTICES, Manifold, Model, State


def _flip(x, axis: int = -2) -> np.ndarray:
    """A vector's x of the other sign; [..., 2, lane]."""
    x = np.asarray(x)
    sign = np.array([-1, 1], x.dtype).reshape([2 if i == x.ndim + axis else 1 for i in range(x.ndim)])
    return x * sign


def _corners(vertices, n_vertices) -> np.ndarray:
    """[polygon, vertex, 2, lane], in the other order, so that they stay clockwise; an unused one stays where it is."""
    flipped = _flip(vertices)
    number, count = np.arange(MAX_VERTICES)[:, None, None], np.asarray(n_vertices)[:, None, None]
    source = np.where(number < count, count - 1 - number, number)  # [polygon, vertex, 1, lane]
    source = np.broadcast_to(source, flipped.shape)
    return np.take_along_axis(flipped, source, axis=1)


def of_model(model: Model) -> Model:
    """Thrusters point the other way along x; a joint's limits change places."""
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
    """A contact's tangent is its normal turned by a quarter, clockwise, so that its impulse changes sign."""
    other_sign = ("rotation", "angular_velocity", "contact_tangent_impulse", "joint_angular_impulse")
    vectors = ("position", "velocity", "joint_impulse")
    return dataclasses.replace(
        state,
        **{name: -np.asarray(getattr(state, name)) for name in other_sign},
        **{name: _flip(getattr(state, name)) for name in vectors},
    )


def of_manifold(manifold: Manifold) -> Manifold:
    return dataclasses.replace(manifold, normal=_flip(manifold.normal), point=_flip(manifold.point))


def of_world(model, state, motor, thrust):
    """Motors are driven the other way."""
    return jax.tree.map(np.asarray, (of_model(model), of_state(state), -np.asarray(motor), thrust))
