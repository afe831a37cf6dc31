"""What is said of levels without an expert, against brute force: many random action sequences, and worlds by hand."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experts.before import Known, facts_of
from experts.witness import take
from levelgen import task
from levelgen.actions import CHOICES
from levelgen.arms import MARGIN, driven, find_arms
from levelgen.distribution import Distribution
from levelgen.level import SIZES, Level, Role
from levelgen.proofs import Proof
from levelgen.sampler import sample_levels
from levelgen.scenery import empty_level
from levelgen.shuffle import separate
from levelgen.task import DEFAULT_RULES, TaskParams
from physics.types import Params, Size
from physics.vector import vec

arms_of = jax.jit(find_arms, static_argnums=1)
ENV_STEPS = 256
LANES = 512  # of one brute-force run
ARMS = Distribution(fixed_chance=0.5, fixed_target_weight=20.0, connected_weight=0.6, extra_thruster_chance=0.5)
FIXED = Distribution(fixed_chance=1.0, lowered_chance=0.5)
# what is sampled, how many, and proofs that must be among them
SAMPLES = {
    "s": (SIZES["s"], Distribution(), 2048, {Proof.NOTHING_ACTS}),
    "m": (SIZES["m"], Distribution(), 2048, {Proof.NOTHING_ACTS, Proof.OUT_OF_REACH}),
    "l": (SIZES["l"], Distribution(), 1024, {Proof.NOTHING_ACTS}),
    "m with arms": (SIZES["m"], ARMS, 2048, {Proof.NOTHING_ACTS, Proof.OUT_OF_REACH}),
    "m with fixed goals": (SIZES["m"], FIXED, 512, {Proof.GOAL_STANDS}),
}


@functools.cache
def sampled(name: str) -> Level:
    size, distribution, count, _ = SAMPLES[name]
    level = jax.tree.map(np.asarray, sample_levels(np.arange(count), size, distribution))
    if name != "m with fixed goals":
        return level
    goals = np.isin(level.role, (Role.GREEN, Role.BLUE))  # by hand: the sampler lets one of them move
    return changed(level, inverse_mass=np.where(goals, 0, level.model.inverse_mass),
                   inverse_inertia=np.where(goals, 0, level.model.inverse_inertia))  # fmt: skip


@functools.cache
def facts(name: str) -> Known:
    return facts_of(sampled(name), DEFAULT_RULES)


def changed(level: Level, **model: Any) -> Level:
    values = {key: np.asarray(x, np.asarray(getattr(level.model, key)).dtype) for key, x in model.items()}
    return dataclasses.replace(level, model=dataclasses.replace(level.model, **values))


@functools.partial(jax.jit, static_argnames=("rules", "steps"))
def play(level: Level, key, sticky, rules: TaskParams = DEFAULT_RULES, steps: int = ENV_STEPS):
    """(done, goal, reward), each [step, lane]: random actions that stay as they are with chance `sticky` [lane]."""
    lanes = level.role.shape[-1]

    def act(carry, key):
        now, action = carry
        fresh, stays = jax.random.split(key)
        drawn = jax.random.randint(fresh, action.shape, 0, jnp.array(CHOICES)[:, None])
        action = jnp.where(jax.random.uniform(stays, action.shape) < sticky, action, drawn)
        now, outcome = task.step(level, now, action, rules)
        return (now, action), (outcome.done, outcome.goal, outcome.reward)

    first = jax.random.randint(key, (len(CHOICES), lanes), 0, jnp.array(CHOICES)[:, None])
    return jax.lax.scan(act, (task.reset(level), first), jax.random.split(key, steps))[1]


def stickiness(lanes: int) -> np.ndarray:
    """Some sequences change at every step, some hardly ever."""
    return np.resize(np.array([0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 1.0], np.float32), lanes)


@pytest.mark.slow
@pytest.mark.parametrize("name", SAMPLES)
def test_no_action_sequence_changes_what_is_proved(name: str) -> None:
    """The goal is never reached; and where the proof says that all but arms moves alike, episodes end as they do."""
    level, known = sampled(name), facts(name)
    proved = np.flatnonzero(known.proof != Proof.NONE)
    assert SAMPLES[name][3] <= {Proof(p) for p in known.proof[proved]}
    places = np.resize(
        np.repeat(proved, max(1, LANES * 4 // len(proved))), -(-max(len(proved), LANES * 4) // LANES) * LANES
    )
    for k, at in enumerate(places.reshape(-1, LANES)):
        done, goal, reward = play(take(level, at), jax.random.key(k), stickiness(LANES))
        assert not np.asarray(goal).any()
        alike = known.proof[at] != Proof.GOAL_STANDS
        idle_done, _, idle_reward = idle(name)
        np.testing.assert_array_equal(np.asarray(done)[:, alike], idle_done[:, at[alike]])
        np.testing.assert_array_equal(np.asarray(reward)[:, alike], idle_reward[:, at[alike]])


@jax.jit
def stay(level: Level):
    nothing = jnp.zeros((len(CHOICES), LANES), jnp.int32)
    return jax.lax.scan(lambda now, _: task.step(level, now, nothing), task.reset(level), length=ENV_STEPS)[1]


@functools.cache
def idle(name: str) -> tuple[np.ndarray, ...]:
    """(done, goal, reward) of doing nothing."""
    level = sampled(name)
    parts = []
    for start in range(0, level.role.shape[-1], LANES):
        parts.append(jax.device_get(stay(take(level, np.arange(start, start + LANES)))))
    reward, done, goal = (np.concatenate(x, -1) for x in zip(*parts, strict=True))
    return done, goal, reward


@pytest.mark.slow
@pytest.mark.parametrize("name", ["s", "m", "l"])
def test_doing_nothing_ends_as_the_task_says(name: str) -> None:
    done, goal, reward = idle(name)
    first = done.argmax(0), np.arange(done.shape[1])
    known = facts(name)
    np.testing.assert_array_equal(known.reaches, goal[first])
    np.testing.assert_array_equal(known.fails, reward[first] < -0.5)
    assert known.reaches.any()
    assert known.fails.any()
    assert not (known.reaches & (known.proof != Proof.NONE)).any()


@pytest.mark.slow
def test_the_outcome_differs_where_nothing_is_proved() -> None:
    """Random actions change how most of the other levels go: the proofs are not empty because nothing matters."""
    level, known = sampled("s"), facts("s")
    others = np.flatnonzero((known.proof == Proof.NONE) & ~known.reaches)[:LANES]
    others = np.resize(others, LANES)
    _, goal, reward = play(take(level, others), jax.random.key(0), stickiness(LANES))
    assert np.asarray(goal).any(0).mean() > 0.2
    assert (np.asarray(reward) != idle("s")[2][:, others]).any(0).mean() > 0.8


@pytest.mark.slow
@pytest.mark.parametrize("strong", [False, True])
def test_arms_stay_within_half_the_margin(strong: bool) -> None:
    """The assumption of Proof.OUT_OF_REACH, of arms alone in the world, as sampled and as strong as it allows."""
    level = jax.tree.map(np.asarray, sample_levels(np.arange(8192), SIZES["m"], ARMS))
    if strong:
        mass = np.take_along_axis(level.model.inverse_mass, level.model.thruster_body, 0)
        power = 4 / np.where(mass == 0, 1, mass) / 2  # two thrusters may share an arm
        level = changed(level, motor_speed=np.full_like(level.model.motor_speed, 3), thruster_power=power,
                        motor_power=np.full_like(level.model.motor_power, 3))  # fmt: skip
    arms = arms_of(level, Params())
    at = np.flatnonzero(arms.known)[:LANES]
    assert len(at) > 200
    level, arms = take(level, np.resize(at, LANES)), take(arms, np.resize(at, LANES))
    level = changed(level, active=level.model.active & ~np.asarray(arms.bystander))
    worst = np.max([beyond(level, arms, jax.random.key(k), stickiness(LANES)) for k in range(4)])
    assert 0.01 < MARGIN + worst < MARGIN / 2, worst


@jax.jit
def beyond(level: Level, arms, key, sticky):
    """How far beyond its reach an arm comes at most, m, physics step by physics step."""
    rules = dataclasses.replace(DEFAULT_RULES, frame_skip=1, max_timesteps=2 * ENV_STEPS)
    radius = jnp.concatenate([vec(level.model.vertices).norm().max(1), level.model.radius])

    def act(carry, key):
        now, action = carry
        fresh, stays = jax.random.split(key)
        drawn = jax.random.randint(fresh, action.shape, 0, jnp.array(CHOICES)[:, None])
        action = jnp.where(jax.random.uniform(stays, action.shape) < sticky, action, drawn)
        now, _ = task.advance(level, now, action, rules)
        gap = (vec(now.state.position) - arms.pivot).norm() + radius - arms.reach
        return (now, action), jnp.where(arms.body, gap, -jnp.inf).max()

    first = jnp.zeros((len(CHOICES), level.role.shape[-1]), jnp.int32)
    return jax.lax.scan(act, (task.reset(level), first), jax.random.split(key, 2 * ENV_STEPS))[1].max()


# Worlds by hand: body 4 is a square of 0.4 m, 5 and 6 are circles of 0.2 m
SQUARE, BALL, OTHER = 4, 5, 6
WORLD = Size(polygons=5, circles=2, joints=1, thrusters=1)


def world(
    *, square=(2.5, 3.0), ball=(1.0, 0.6), other=(4.0, 0.6), roles=(Role.PLAIN, Role.GREEN, Role.BLUE), fixed=(),
    joint=None, thruster=None, **model: Any,
) -> Level:  # fmt: skip
    """One level with three bodies at these places. `joint` is (a, b), `thruster` is a body."""
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
    return changed(level, collides=np.asarray(separate(m)))


def proof(level: Level, rules: TaskParams = DEFAULT_RULES) -> Proof:
    return Proof(int(facts_of(level, rules).proof[0]))


def test_nothing_acts() -> None:
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


def test_where_doing_nothing_reaches_the_goal_or_never_ends_nothing_is_proved() -> None:
    assert proof(world(other=(1.3, 0.6))) is Proof.NONE
    assert bool(facts_of(world(other=(1.3, 0.6)), DEFAULT_RULES).reaches[0])
    assert proof(world(), TaskParams(max_timesteps=300)) is Proof.NONE  # only 256 are watched


def test_goal_stands() -> None:
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


def test_red_first_is_a_failure() -> None:
    level = world(other=(1.3, 0.6), square=(1.0, 0.9), roles=(Role.RED, Role.GREEN, Role.BLUE))
    known = facts_of(level, DEFAULT_RULES)
    assert bool(known.fails[0])
    assert not bool(known.reaches[0])
    assert Proof(int(known.proof[0])) is Proof.NOTHING_ACTS


ARM = {"fixed": (SQUARE,), "joint": (SQUARE, OTHER), "other": (2.5, 3.0), "roles": (Role.GREEN, Role.BLUE, Role.PLAIN)}


def test_out_of_reach() -> None:
    """A ball turns on a fixed square in the middle; another one lies in the corner."""
    assert proof(world(**ARM)) is Proof.OUT_OF_REACH


@pytest.mark.parametrize(
    "change",
    [
        {"ball": (1.8, 3.6)},  # within reach
        {"ball": (2.5, 5.0)},  # falls through the reach
        {"square": (2.5, 1.0), "other": (2.5, 1.0)},  # the arm may touch the floor
        {"roles": (Role.PLAIN, Role.BLUE, Role.GREEN)},  # the arm is a goal
        {"roles": (Role.GREEN, Role.BLUE, Role.RED)},
        {"motor_speed": 4},  # stronger than measured
        {"motor_power": 4},
        {"fixed": ()},  # nothing holds it
        {"thruster": BALL},  # something else acts
        {"other": (2.5, 3.6), "joint_anchor_b": 0.0},  # its joint is torn at the start
    ],
    ids=str,
)
def test_no_arm_out_of_reach(change: dict[str, Any]) -> None:
    assert proof(world(**(ARM | change))) is Proof.NONE


def test_other_constants_of_the_engine_prove_no_reach() -> None:
    assert proof(world(**ARM), TaskParams(physics=Params(joint_stiffness=0.1))) is Proof.NONE


def test_an_arm_that_shares_solver_batches_with_others_is_not_out_of_reach() -> None:
    """Size l solves pairs of polygons in four batches: whether an arm touches its base decides who is in which."""
    few, many = world(**ARM), world(**ARM)
    assert proof(few) is Proof.OUT_OF_REACH
    assert not np.asarray(arms_of(few, Params()).mixing).any()
    wide = wider(many, polygons=12, circles=4)
    assert np.asarray(driven(wide)).sum() == 1
    assert np.asarray(arms_of(wide, Params()).mixing).any()
    assert proof(wide) is Proof.NONE


def wider(level: Level, polygons: int, circles: int) -> Level:
    """The same level in a size with more places."""
    old, new = level.size, Size(polygons, circles, level.size.joints, level.size.thrusters)
    blank = jax.tree.map(np.array, empty_level(new, 1))
    to = np.concatenate([np.arange(old.polygons), polygons + np.arange(old.circles)])
    for name in ("active", "inverse_mass", "inverse_inertia"):
        getattr(blank.model, name)[to] = getattr(level.model, name)
    blank.model.vertices[: old.polygons], blank.model.radius[: old.circles] = level.model.vertices, level.model.radius
    blank.state.position[to], blank.role[to] = level.state.position, level.role
    for name in ("joint_active", "joint_anchor_a", "joint_anchor_b", "motor_on", "motor_speed", "motor_power"):
        getattr(blank.model, name)[...] = getattr(level.model, name)
    blank.model.joint_a[...], blank.model.joint_b[...] = to[level.model.joint_a], to[level.model.joint_b]
    return changed(blank, collides=np.asarray(separate(blank.model)))
