"""Facts and proofs about levels against brute force: many random action sequences, and handmade worlds."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.experts.verdict.before import facts_of
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import SIZES, Level, Role
from levelproof.levelgen.proofs import Facts, Proof
from levelproof.levelgen.sampling.distribution import Distribution
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.sampling.shuffle import collision_matrix
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import CHOICES
from levelproof.levelgen.task.rules import DEFAULT_RULES, TaskParams
from levelproof.physics.types import Params, Size
from tests.levelgen.mutants import mutants

ENV_STEPS = 256
LANES = 512  # of one brute-force run
JOINED = Distribution(fixed_chance=0.5, fixed_target_weight=20.0, connected_weight=0.6, extra_thruster_chance=0.5)
DEFAULT = Distribution()
FIXED = Distribution(fixed_chance=1.0, lowered_chance=0.5)


@dataclasses.dataclass(frozen=True)
class Sample:
    """Sampled levels: how they are drawn and changed, and which proofs must occur among them."""

    size: str
    count: int
    proofs: frozenset[Proof]
    distribution: Distribution = DEFAULT
    mutated: bool = False
    rules: TaskParams = DEFAULT_RULES


ACTS, STANDS = Proof.NOTHING_ACTS, Proof.GOAL_STANDS
# their own time step and limit, no dense reward, no padding defect
OTHER_RULES = TaskParams(frame_skip=3, max_timesteps=96, dense_reward_scale=0, physics=Params(faithful_padding=False))
# worlds that break down: the auto motors tear joints, bodies leave the room
STRONG = Params(motor_power=9000, thruster_power=300, joint_stiffness=0.9, max_velocity=1000)
STRONG_RULES = TaskParams(physics=STRONG)
SAMPLES = {
    "s": Sample("s", 512, frozenset({ACTS})),
    "s mutated": Sample("s", 512, frozenset({ACTS, STANDS}), FIXED, mutated=True),
    "m": Sample("m", 2048, frozenset({ACTS})),
    "l": Sample("l", 1024, frozenset({ACTS})),
    "m with fixed goals": Sample("m", 512, frozenset({STANDS}), FIXED),
    "m mutated": Sample("m", 4096, frozenset({ACTS, STANDS}), JOINED, mutated=True),
    "l mutated": Sample("l", 1024, frozenset({ACTS, STANDS}), JOINED, mutated=True),
    "m mutated, other rules": Sample("m", 2048, frozenset({ACTS, STANDS}), JOINED, True, OTHER_RULES),
    "m mutated, strong": Sample("m", 2048, frozenset({ACTS, STANDS}), JOINED, True, STRONG_RULES),
}
MORE = pytest.mark.campaign
BRUTE_FORCE = ["s mutated", *(pytest.param(name, marks=MORE) for name in SAMPLES if name != "s mutated")]


@functools.cache
def sampled(name: str) -> Level:
    sample = SAMPLES[name]
    if sample.mutated:
        return mutants(sample.size, sample.count, sample.distribution)
    level = jax.tree.map(np.asarray, sample_levels(jnp.arange(sample.count), SIZES[sample.size], sample.distribution))
    if name != "m with fixed goals":
        return level
    goals = np.isin(level.role, (Role.GREEN, Role.BLUE))  # fixed here, because the sampler lets one of them move
    return changed(level, inverse_mass=np.where(goals, 0, level.model.inverse_mass),
                   inverse_inertia=np.where(goals, 0, level.model.inverse_inertia))  # fmt: skip


@functools.cache
def facts(name: str) -> Facts:
    return facts_of(sampled(name), SAMPLES[name].rules)


def changed(level: Level, **model: Any) -> Level:
    values = {key: np.asarray(x, np.asarray(getattr(level.model, key)).dtype) for key, x in model.items()}
    return dataclasses.replace(level, model=dataclasses.replace(level.model, **values))


def play(level: Level, key, sticky, rules: TaskParams = DEFAULT_RULES, steps: int = ENV_STEPS, choices=CHOICES):
    """Play random actions that repeat with probability `sticky` [lane]; return (done, goal, reward), each [step, lane].

    `choices` [entry] is the number of choices of each entry of an action; an entry with one choice does nothing.
    """
    return _play(level, key, sticky, np.asarray(choices)[:, None], rules, steps)  # traced: one program serves all


@functools.partial(jax.jit, static_argnames=("rules", "steps"))
def _play(level: Level, key, sticky, choices, rules: TaskParams, steps: int):
    lanes = level.role.shape[-1]

    def act(carry, key):
        now, action = carry
        fresh, stays = jax.random.split(key)
        drawn = jax.random.randint(fresh, action.shape, 0, choices)
        action = jnp.where(jax.random.uniform(stays, action.shape) < sticky, action, drawn)
        now, result = task.step(level, now, action, rules)
        return (now, action), (result.done, result.goal, result.reward)

    first = jax.random.randint(key, (len(choices), lanes), 0, choices)
    return jax.lax.scan(act, (task.reset(level), first), jax.random.split(key, steps))[1]


def stickiness(first: int = 0) -> np.ndarray:
    """Return repeat probabilities: some sequences change at every step, some hardly ever."""
    return np.resize(np.roll(np.array([0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 1.0], np.float32), first), LANES)


@pytest.mark.slow
@pytest.mark.parametrize("name", BRUTE_FORCE)
def test_random_actions_never_contradict_a_proof(name: str) -> None:
    """The goal is never reached; and if nothing acts, episodes end as idle ones do."""
    level, known, rules = sampled(name), facts(name), SAMPLES[name].rules
    proved = np.flatnonzero(known.proof != Proof.NONE)
    assert SAMPLES[name].proofs <= {Proof(p) for p in known.proof[proved]}
    idle_done, _, idle_reward = idle(name)
    plays = -(-max(len(proved), 2 * LANES) // LANES)
    for k, at in enumerate(np.resize(proved, plays * LANES).reshape(plays, LANES)):
        done, goal, reward = play(take(level, at), jax.random.key(k), stickiness(k), rules)
        assert not np.asarray(goal).any()
        alike = known.proof[at] == Proof.NOTHING_ACTS
        np.testing.assert_array_equal(np.asarray(done)[:, alike], idle_done[:, at[alike]])
        np.testing.assert_array_equal(np.asarray(reward)[:, alike], idle_reward[:, at[alike]])


@functools.cache
def idle(name: str) -> tuple[np.ndarray, ...]:
    """Return (done, goal, reward) of an idle episode."""
    level, rules, nothing = sampled(name), SAMPLES[name].rules, np.ones_like(CHOICES)
    parts = []
    for start in range(0, level.role.shape[-1], LANES):
        lanes = take(level, np.arange(start, start + LANES))
        parts.append(jax.device_get(play(lanes, jax.random.key(0), stickiness(), rules, choices=nothing)))
    return tuple(np.concatenate(x, -1) for x in zip(*parts, strict=True))


@pytest.mark.parametrize("name", ["s", pytest.param("m", marks=MORE), pytest.param("l", marks=MORE)])
def test_facts_agree_with_an_idle_episode(name: str) -> None:
    done, goal, reward = idle(name)
    first = done.argmax(0), np.arange(done.shape[1])
    known = facts(name)
    np.testing.assert_array_equal(known.reaches, goal[first])
    np.testing.assert_array_equal(known.fails, reward[first] < -0.5)
    assert known.reaches.any()
    assert known.fails.any()
    assert not (known.reaches & (known.proof != Proof.NONE)).any()


def test_random_actions_change_outcomes_of_unproved_levels() -> None:
    """Random actions change most of the other levels, so proofs do not hold merely because actions never matter."""
    level, known = sampled("s"), facts("s")
    others = np.flatnonzero((known.proof == Proof.NONE) & ~known.reaches)[:LANES]
    others = np.resize(others, LANES)
    _, goal, reward = play(take(level, others), jax.random.key(0), stickiness())
    assert np.asarray(goal).any(0).mean() > 0.2
    assert (np.asarray(reward) != idle("s")[2][:, others]).any(0).mean() > 0.8


# Handmade worlds: body 4 is a square of 0.4 m, 5 and 6 are circles of 0.2 m
SQUARE, BALL, OTHER = 4, 5, 6
WORLD = Size(polygons=5, circles=2, joints=1, thrusters=1)


def world(
    *, square=(2.5, 3.0), ball=(1.0, 0.6), other=(4.0, 0.6), roles=(Role.PLAIN, Role.GREEN, Role.BLUE), fixed=(),
    joint=None, thruster=None, **model: Any,
) -> Level:  # fmt: skip
    """Return a level with three bodies at these positions. `joint` is (a, b), `thruster` is a body."""
    level = jax.tree.map(np.array, empty_level(WORLD, 1))
    m, bodies = level.model, slice(SQUARE, OTHER + 1)
    m.active[bodies] = True
    m.vertices[SQUARE, ..., 0] = 0.2 * np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)])
    m.radius[:] = 0.2
    m.inverse_mass[bodies, 0], m.inverse_inertia[bodies, 0] = 1 / 0.16, 3 / (0.16 * 0.08)
    for body in fixed:
        m.inverse_mass[body] = m.inverse_inertia[body] = 0
    level.state.position[bodies, :, 0] = square, ball, other
    level.role[bodies, 0] = roles
    if joint:
        a, b = joint
        m.joint_active[0], m.joint_a[0], m.joint_b[0] = True, a, b
        m.joint_anchor_b[0, :, 0] = level.state.position[a, :, 0] - level.state.position[b, :, 0]
        m.motor_on[0], m.motor_speed[0], m.motor_power[0] = True, 1, 1
    if thruster:
        m.thruster_active[0], m.thruster_body[0], m.thruster_power[0] = True, thruster, 1
    for name, value in model.items():
        getattr(m, name)[...] = value
    return changed(level, collides=np.asarray(collision_matrix(m)))


def proof(level: Level, rules: TaskParams = DEFAULT_RULES) -> Proof:
    return Proof(int(facts_of(level, rules).proof[0]))


def test_levels_without_effective_actuators_prove_nothing_acts() -> None:
    assert proof(world()) is Proof.NOTHING_ACTS
    assert proof(world(thruster=BALL)) is Proof.NONE
    assert proof(world(thruster=BALL, thruster_power=0)) is Proof.NOTHING_ACTS
    assert proof(world(thruster=SQUARE, fixed=(SQUARE,))) is Proof.NOTHING_ACTS
    joined = {"joint": (SQUARE, BALL), "ball": (2.5, 3.1)}
    assert proof(world(**joined)) is Proof.NONE
    assert proof(world(**joined, motor_speed=0)) is Proof.NONE  # a brake
    for off in ({"motor_on": False}, {"motor_power": 0}, {"joint_fixed": True}):
        assert proof(world(**joined, **off)) is Proof.NOTHING_ACTS
    assert proof(world(**joined, fixed=(SQUARE, BALL))) is not Proof.NONE
    alone = dataclasses.replace(world(**joined), motor_auto=np.ones((1, 1), bool))
    assert proof(alone) is Proof.NOTHING_ACTS


def test_idle_episodes_that_reach_the_goal_or_never_end_prove_nothing() -> None:
    assert proof(world(other=(1.3, 0.6))) is Proof.NONE
    assert bool(facts_of(world(other=(1.3, 0.6)), DEFAULT_RULES).reaches[0])
    assert proof(world(), TaskParams(max_timesteps=300)) is Proof.NONE  # only 256 steps are examined


def test_still_goals_prove_goal_stands() -> None:
    still = {"fixed": (BALL, OTHER), "thruster": SQUARE}
    assert proof(world(**still)) is Proof.GOAL_STANDS
    assert proof(world(**{**still, "fixed": (BALL,)})) is Proof.NONE
    drifting = world(**still)
    drifting.state.velocity[BALL, 0] = 0.1  # immovable, and moving
    assert proof(drifting) is Proof.NONE
    no_blue = world(thruster=BALL, roles=(Role.PLAIN, Role.GREEN, Role.PLAIN))
    assert proof(no_blue) is Proof.GOAL_STANDS
    not_a_number = world(**still)
    not_a_number.state.velocity[SQUARE, 0] = np.nan
    assert proof(not_a_number) is Proof.NONE


def test_touching_red_first_fails() -> None:
    level = world(other=(1.3, 0.6), square=(1.0, 0.9), roles=(Role.RED, Role.GREEN, Role.BLUE))
    known = facts_of(level, DEFAULT_RULES)
    assert bool(known.fails[0])
    assert not bool(known.reaches[0])
    assert Proof(int(known.proof[0])) is Proof.NOTHING_ACTS


def test_actuator_out_of_reach_proves_nothing() -> None:
    """A ball turns on a fixed square in the middle, another lies in the corner. Joints are soft: nothing is proved."""
    arm = {"fixed": (SQUARE,), "joint": (SQUARE, OTHER), "other": (2.5, 3.0)}
    assert proof(world(**arm, roles=(Role.GREEN, Role.BLUE, Role.PLAIN))) is Proof.NONE


@pytest.mark.slow
def test_huge_values_prove_nothing() -> None:
    """A thruster on an immovable body does nothing, unless its force is infinite: zero times infinity is NaN."""
    still = {"thruster": SQUARE, "fixed": (SQUARE,)}
    assert proof(world(**still, thruster_power=1e8)) is Proof.NOTHING_ACTS
    assert proof(world(**still, thruster_power=1e38)) is Proof.NONE
    assert proof(world(**still, thruster_power=1e33), TaskParams(physics=Params(thruster_power=1e6))) is Proof.NONE


def test_body_at_a_nan_position_touches_nothing() -> None:
    """A body of a broken world, whose position is NaN, cannot reach a goal that its old position would."""
    level = world(other=(1.3, 0.6))
    done, goal, _ = play(take(level, np.zeros(LANES, int)), jax.random.key(0), stickiness(), steps=1)
    assert np.asarray(goal).all()
    level.state.position[OTHER] = np.nan
    done, goal, _ = play(take(level, np.zeros(LANES, int)), jax.random.key(0), stickiness(), steps=1)
    assert np.asarray(done).all()
    assert not np.asarray(goal).any()
