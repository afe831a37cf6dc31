"""The assumption of Proof.OUT_OF_REACH, on arms built against it: as strong, long and light as `find_arms` takes."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelgen.arms import MARGIN, MAX_GAP, MAX_LENGTH, MAX_MOTOR, MAX_PUSH, MAX_TURN, SWING, Arms, find_arms, radii
from levelgen.level import Level
from levelgen.sampling.scenery import empty_level
from levelgen.sampling.shuffle import separate
from levelgen.task import rules as task
from levelgen.task.actions import CHOICES
from physics.types import Params, Size
from physics.vector import vec

WORLD = Size(polygons=6, circles=0, joints=1, thrusters=2)
BASE, ARM = 4, 5
LANES = 2048
SECONDS = 8
WORST = 0.6  # of the room that SWING and MARGIN give; in 8 seeds of every kind, 0.46
KINDS = ("free", "limited", "limits left behind", "fixed", "small", "joint outside", "thruster outside")


def made(kind: str, seed: int = 0) -> Level:
    """Arms on a fixed body in the middle of the room, another in every lane."""
    random = np.random.default_rng((seed, KINDS.index(kind)))
    blank = jax.tree.map(np.asarray, empty_level(WORLD, 1))
    level = jax.tree.map(lambda x: np.repeat(x, LANES, -1), blank)
    model, state = level.model, level.state
    uniform = lambda low, high, *shape: random.uniform(low, high, (*shape, LANES))
    extreme = lambda most, *shape: np.clip(uniform(-2 * most, 2 * most, *shape), -most, most)
    square = 0.5 * np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)])
    sides = np.exp(uniform(*np.log((0.02, 0.15) if kind == "small" else (0.03, 1.0)), 1, 2))
    model.active[BASE:], model.vertices[BASE], model.vertices[ARM] = (
        True,
        0.2 * square[..., None],
        square[..., None] * sides,
    )
    radius, mass = np.hypot(*sides[0]) / 2, np.exp(uniform(*np.log((1e-3, 50))))
    model.inverse_mass[ARM] = 1 / mass
    model.inverse_inertia[ARM] = np.clip(np.exp(uniform(-1, 3)), 1.001, 7.999) / (radius**2 * mass)
    model.gravity[:] = 9.99 * turned((1, 0), uniform(-4, 4))
    state.rotation[BASE:] = uniform(-4, 4, 2)
    far = 1.0 if kind == "joint outside" else np.minimum(0.999 * radius, 0.999)
    model.joint_anchor_a[0] = uniform(-0.3, 0.3, 2)
    model.joint_anchor_b[0] = np.clip(uniform(0, 1.5), 0, 1) * far * turned((1, 0), uniform(-4, 4))
    pivot = 2.7 + turned(model.joint_anchor_a[0], state.rotation[BASE])
    state.position[BASE], state.position[ARM] = 2.7, pivot - turned(model.joint_anchor_b[0], state.rotation[ARM])
    model.joint_active[0], model.joint_a[0], model.joint_b[0], model.motor_on[0] = True, BASE, ARM, True
    model.motor_speed[0], model.motor_power[0] = extreme(MAX_MOTOR), extreme(MAX_MOTOR)
    share, at = np.clip(uniform(-0.5, 1.5), 0, 1), 10.0 if kind == "thruster outside" else 1.0
    model.thruster_active[:], model.thruster_body[:] = True, ARM
    model.thruster_power[:] = 0.999 * MAX_PUSH * mass * np.stack([share, (1 - share) * random.choice([-1, 1], LANES)])
    model.thruster_position[:] = np.moveaxis(at * radius * turned((1, 0), uniform(-4, 4, 2)), 0, 1)
    model.thruster_rotation[:], level.thruster_binding[1] = uniform(-4, 4, 2), 1
    angle = state.rotation[ARM] - state.rotation[BASE]
    if kind.startswith("limit"):
        off = uniform(-MAX_TURN, MAX_TURN) * (20 if kind == "limits left behind" else 1)
        model.joint_limited[0], model.joint_min[0] = True, angle + off
        model.joint_max[0] = angle + off + np.maximum(uniform(-5, 10), 0)
    if kind == "fixed":
        model.joint_fixed[0], model.joint_rotation[0] = True, angle + uniform(-MAX_TURN, MAX_TURN)
    return dataclasses.replace(level, model=dataclasses.replace(model, collides=np.asarray(separate(model))))


def turned(vector, angle) -> np.ndarray:
    """(2, ...)"""
    x, y = vector
    return np.stack([x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)])


@functools.partial(jax.jit, static_argnames="steps")
def farthest(level: Level, arms: Arms, key, sticky, steps: int = 60 * SECONDS):
    """How much of the room beyond its length each arm's centre uses at most [lane], physics step by physics step."""
    rules = dataclasses.replace(task.DEFAULT_RULES, frame_skip=1, max_timesteps=steps)
    room = arms.reach[ARM] - radii(level.model)[ARM]
    length = (room - MARGIN) / (1 + SWING)

    def act(carry, key):
        now, action, most = carry
        fresh, stays = jax.random.split(key)
        drawn = jax.random.randint(fresh, action.shape, 0, jnp.array(CHOICES)[:, None])
        action = jnp.where(jax.random.uniform(stays, action.shape) < sticky, action, drawn)
        now, _ = task.advance(level, now, action, rules)
        distance = (vec(now.state.position) - arms.pivot).norm()[ARM]
        return (now, action, jnp.maximum(most, (distance - length) / (room - length))), None

    first = jax.random.randint(key, (len(CHOICES), LANES), 0, jnp.array(CHOICES)[:, None])
    start = task.reset(level), first, jnp.zeros(LANES)
    return jax.lax.scan(act, start, jax.random.split(key, steps))[0][2]


arms_of = jax.jit(find_arms, static_argnums=1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_no_arm_leaves_its_reach(kind: str) -> None:
    level = made(kind)
    arms = arms_of(level, Params())
    known = np.asarray(arms.known)
    if kind == "thruster outside":
        assert not known.any()
        return
    assert known.any()
    sticky = np.resize(np.array([0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 1.0], np.float32), LANES)
    used = np.asarray(farthest(level, arms, jax.random.key(0), sticky))
    assert (used[known] < WORST).all(), used[known].max()
    if kind in ("limits left behind", "joint outside"):  # the bounds are there for a reason
        assert not (used[~known] < 1).all()  # or not a number
    else:
        assert known.mean() > 0.2


def test_the_bounds_are_what_the_worlds_were_made_for() -> None:
    """Each bound by itself: a little within is an arm, a little beyond is none."""
    level = made("free")
    at = int(np.flatnonzero(np.asarray(arms_of(level, Params()).known))[0])
    one = jax.tree.map(lambda x: x[..., at : at + 1], level)
    assert arms_of(one, Params()).known.all()
    m, radius = one.model, float(radii(one.model)[ARM, 0])
    push = (radius + 2 * MAX_GAP) * np.array([1.0, 0.0])
    for name, index, value in (
        ("thruster_position", (0, slice(None), 0), push),
        ("motor_speed", (0, 0), 1.01 * MAX_MOTOR),
        ("motor_power", (0, 0), -1.01 * MAX_MOTOR),
        ("thruster_power", (0, 0), 1.01 * MAX_PUSH / m.inverse_mass[ARM, 0]),
        ("joint_anchor_b", (0, slice(None), 0), (MAX_LENGTH + 0.1) * np.array([1.0, 0.0])),
        ("inverse_inertia", (ARM, 0), 9 * m.inverse_mass[ARM, 0] / radius**2),
        ("gravity", (slice(None), 0), np.array([0.0, -11.0])),
    ):
        values = np.array(getattr(m, name))
        values[index] = value
        beyond = dataclasses.replace(one, model=dataclasses.replace(m, **{name: values}))
        assert not arms_of(beyond, Params()).known.any(), name
