"""Small handmade worlds for tests of the engine."""

import dataclasses

import jax
import numpy as np

from levelproof.physics.buffers import zeros_of
from levelproof.physics.pairs import pairs_of
from levelproof.physics.types import FIXED_POLYGONS, Model, Params, Size, State

ROOM = Size(polygons=5, circles=2, joints=1, thrusters=1)  # one movable polygon (4) and two circles (5, 6)
BOX, BALL, OTHER = 4, 5, 6
FLOOR_TOP = 0.4  # m
HALF = 0.2  # m, of the box's side
RADIUS = 0.25  # m, of the circles
MASS = 2.0  # kg
LANES = 8  # one whole vector; all alike unless a test changes them
PARAMS = Params()
WALLS = ((2.5, -4.6), (-5.0, 2.5), (10.0, 2.5), (2.5, 10.0))  # centres of 10 m boxes


def room(lanes: int = LANES, gravity: float = -9.81) -> tuple[Model, State]:
    """Return a box and two balls, apart from each other, in a closed room; joints and thrusters are inactive."""
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
    state = dataclasses.replace(zeros_of(State, ROOM, lanes), position=position)
    return jax.tree.map(np.asarray, (model, state))


def changed(tree, **rows):
    """Return `tree` with `name={index: value}` written into its fields, in all lanes.

    >>> changed(state, velocity={BOX: (1.0, 0.0)})
    """
    fields = {}
    for name, values in rows.items():
        fields[name] = np.array(getattr(tree, name))
        for index, value in values.items():
            fields[name][index] = np.asarray(value, fields[name].dtype)[..., None]
    return dataclasses.replace(tree, **fields)


def idle(lanes: int = LANES) -> tuple[np.ndarray, np.ndarray]:
    """Return controls with motors and thrusters off."""
    return np.zeros((ROOM.joints, lanes), np.float32), np.zeros((ROOM.thrusters, lanes), np.float32)


def scattered(size: Size, lanes: int, seed: int = 1) -> tuple[Model, State, np.ndarray, np.ndarray]:
    """Return random worlds of any size, different in each lane, with controls of motors and thrusters.

    Bodies are scattered about a room, overlapping and moving, some inactive, joined at random, with contact impulses to
    warm-start from.
    """
    random = np.random.default_rng(seed)
    uniform = lambda low, high, *shape: random.uniform(low, high, (*shape, lanes)).astype(np.float32)
    chance = lambda share, *shape: random.random((*shape, lanes)) < share
    polygons, circles, joints, thrusters = size
    bodies, contacts = size.bodies, pairs_of(size).contacts
    fixed = (np.arange(bodies) < FIXED_POLYGONS)[:, None]

    square = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)], np.float32)  # clockwise
    vertices = square[:, :, None] * uniform(0.1, 0.5, polygons, 1, 2)
    vertices[:FIXED_POLYGONS] = 5 * square[:, :, None]
    triangle = chance(0.3, polygons) & ~fixed[:polygons]
    corner = np.array([(0, 0.3), (0.3, -0.15), (-0.3, -0.15), (0, 0)], np.float32)
    vertices = np.where(triangle[:, None, None], corner[:, :, None], vertices)

    joint_a = random.integers(0, bodies, (joints, lanes), np.int32)
    joint_b = (joint_a + random.integers(1, bodies, (joints, lanes), np.int32)) % bodies
    joint_active, collides = chance(0.8, joints), np.ones((bodies, bodies, lanes), bool)
    lane = np.arange(lanes)
    for a, b, active in zip(joint_a, joint_b, joint_active, strict=True):
        collides[a[active], b[active], lane[active]] = collides[b[active], a[active], lane[active]] = False
    inverse_mass = np.where(fixed | chance(0.1, bodies), 0, uniform(0.2, 5, bodies))
    low, high = np.sort(uniform(-1, 1, 2, joints), axis=0)
    model = Model(
        gravity=np.stack([uniform(-1, 1), uniform(-10, 0)]),
        active=fixed | chance(0.9, bodies),
        inverse_mass=inverse_mass.astype(np.float32),
        inverse_inertia=np.where(inverse_mass == 0, 0, uniform(1, 100, bodies)).astype(np.float32),
        friction=uniform(0, 1, bodies),
        restitution=np.where(chance(0.5, bodies), 0, uniform(0, 1, bodies)).astype(np.float32),
        collision_mode=np.where(fixed, 1, random.choice([0, 1, 1, 1, 2], (bodies, lanes))).astype(np.int32),
        collides=collides,
        vertices=vertices.astype(np.float32),
        n_vertices=np.where(triangle, 3, 4).astype(np.int32),
        radius=uniform(0.1, 0.5, circles),
        joint_active=joint_active,
        joint_a=joint_a,
        joint_b=joint_b,
        joint_anchor_a=uniform(-0.3, 0.3, joints, 2),
        joint_anchor_b=uniform(-0.3, 0.3, joints, 2),
        joint_fixed=chance(0.3, joints),
        joint_rotation=uniform(-1, 1, joints),
        joint_limited=chance(0.5, joints),
        joint_min=low,
        joint_max=high,
        motor_on=chance(0.7, joints),
        motor_speed=uniform(0, 2, joints),
        motor_power=uniform(0, 2, joints),
        thruster_active=chance(0.7, thrusters),
        thruster_body=random.integers(FIXED_POLYGONS, bodies, (thrusters, lanes), np.int32),
        thruster_position=uniform(-0.3, 0.3, thrusters, 2),
        thruster_rotation=uniform(-3, 3, thrusters),
        thruster_power=uniform(0, 2, thrusters),
    )
    walls = np.broadcast_to(np.array(WALLS, np.float32)[..., None], (FIXED_POLYGONS, 2, lanes))
    still = lambda x: np.where(fixed.reshape(-1, *[1] * (x.ndim - 1)), np.float32(0), x)
    remembered = chance(0.5, contacts)
    state = State(
        position=np.concatenate([walls, uniform(0.2, 4.8, bodies - FIXED_POLYGONS, 2)]),
        rotation=still(uniform(-4, 4, bodies)),
        velocity=still(uniform(-3, 3, bodies, 2)),
        angular_velocity=still(uniform(-5, 5, bodies)),
        contact_active=remembered,
        contact_normal_impulse=remembered * uniform(0, 0.5, contacts),
        contact_tangent_impulse=remembered * uniform(-0.1, 0.1, contacts),
        joint_impulse=uniform(-0.1, 0.1, joints, 2),
        joint_angular_impulse=uniform(-0.01, 0.01, joints),
    )
    return model, state, uniform(-1, 1, joints) * chance(0.7, joints), uniform(0, 1, thrusters)
