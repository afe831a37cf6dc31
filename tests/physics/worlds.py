"""Small worlds made by hand, for tests of the engine."""

import dataclasses

import jax
import numpy as np

from physics.pairs import pairs_of
from physics.types import Model, Params, Size, State, initial_state

ROOM = Size(polygons=5, circles=2, joints=1, thrusters=1)  # one movable polygon (4) and two circles (5, 6)
BOX, BALL, OTHER = 4, 5, 6
FLOOR_TOP = 0.4  # m
HALF = 0.2  # m, of the box's side
RADIUS = 0.25  # m, of the circles
MASS = 2.0  # kg
LANES = 8  # all alike, where nothing else is said: a whole vector
PARAMS = Params()
WALLS = ((2.5, -4.6), (-5.0, 2.5), (10.0, 2.5), (2.5, 10.0))  # centres of 10 m boxes


def room(lanes: int = LANES, gravity: float = -9.81) -> tuple[Model, State]:
    """A box and two balls apart from each other in a closed room, nothing active but the room and they."""
    polygons, circles, joints, thrusters = ROOM
    bodies = polygons + circles

    def full(shape, value, dtype=np.float32):
        return np.broadcast_to(np.asarray(value, dtype)[..., None], (*shape, lanes)).copy()

    square = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)], np.float32)  # clockwise
    vertices = np.stack([square * (5.0 if polygon < 4 else HALF) for polygon in range(polygons)])
    movable = np.arange(bodies) >= 4
    inertia = np.where(np.arange(bodies) < polygons, MASS * (2 * HALF) ** 2 / 6, MASS * RADIUS**2 / 2)
    model = Model(
        gravity=full((2,), [0.0, gravity]),
        active=full((bodies,), True, bool),
        inverse_mass=full((bodies,), movable / MASS),
        inverse_inertia=full((bodies,), movable / inertia),
        friction=full((bodies,), np.ones(bodies)),
        restitution=full((bodies,), np.zeros(bodies)),
        collision_mode=full((bodies,), np.ones(bodies), np.int32),
        collides=full((bodies, bodies), np.ones((bodies, bodies)), bool),
        vertices=full(vertices.shape, vertices),
        n_vertices=full((polygons,), np.full(polygons, 4), np.int32),
        radius=full((circles,), np.full(circles, RADIUS)),
        joint_active=full((joints,), np.zeros(joints), bool),
        joint_a=full((joints,), np.full(joints, BOX), np.int32),
        joint_b=full((joints,), np.full(joints, BALL), np.int32),
        joint_anchor_a=full((joints, 2), np.zeros((joints, 2))),
        joint_anchor_b=full((joints, 2), np.zeros((joints, 2))),
        joint_fixed=full((joints,), np.zeros(joints), bool),
        joint_rotation=full((joints,), np.zeros(joints)),
        joint_limited=full((joints,), np.zeros(joints), bool),
        joint_min=full((joints,), np.zeros(joints)),
        joint_max=full((joints,), np.zeros(joints)),
        motor_on=full((joints,), np.ones(joints), bool),
        motor_speed=full((joints,), np.ones(joints)),
        motor_power=full((joints,), np.ones(joints)),
        thruster_active=full((thrusters,), np.zeros(thrusters), bool),
        thruster_body=full((thrusters,), np.full(thrusters, BOX), np.int32),
        thruster_position=full((thrusters, 2), np.zeros((thrusters, 2))),
        thruster_rotation=full((thrusters,), np.zeros(thrusters)),
        thruster_power=full((thrusters,), np.ones(thrusters)),
    )
    position = full((bodies, 2), np.array([*WALLS, (1.0, 2.0), (2.5, 2.0), (4.0, 2.0)]))
    zeros = full((bodies,), np.zeros(bodies))
    state = initial_state(
        position, zeros, full((bodies, 2), np.zeros((bodies, 2))), zeros, pairs_of(ROOM).contacts, joints
    )
    return jax.tree.map(np.asarray, (model, state))


def changed(tree, **rows):
    """`tree` with `name={index: value}` written into its fields, in all lanes.

    >>> changed(state, velocity={BOX: (1.0, 0.0)})
    """
    fields = {}
    for name, values in rows.items():
        fields[name] = np.array(getattr(tree, name))
        for index, value in values.items():
            fields[name][index] = np.asarray(value, fields[name].dtype)[..., None]
    return dataclasses.replace(tree, **fields)


def idle(lanes: int = LANES) -> tuple[np.ndarray, np.ndarray]:
    """Motors and thrusters off."""
    return np.zeros((ROOM.joints, lanes), np.float32), np.zeros((ROOM.thrusters, lanes), np.float32)
