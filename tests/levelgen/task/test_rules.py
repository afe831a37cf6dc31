"""The task: rewards, ends and restarts, against the reference and from first principles."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.levelgen.level import Level, Role
from levelproof.levelgen.task.measures import goal_distance
from levelproof.levelgen.task.rules import (
    NO_DISTANCE,
    TaskParams,
    TaskState,
    advance,
    has_nan,
    has_roles,
    reset,
    restart,
    step,
    touches,
)
from levelproof.physics.pairs import pairs_of
from levelproof.physics.types import Manifold
from tests.golden.load import Golden, golden

OFF = 0  # every entry of an action


@functools.cache
def env_step(size: str):
    """Take our env step from every golden state: return the next task state and the result, on the host."""
    sample = golden(size)
    params = TaskParams(
        frame_skip=sample.about["frame_skip"], dense_reward_scale=float(np.float32(sample.about["dense_reward_scale"]))
    )
    now = TaskState(sample.state, sample.timestep, sample.last_distance)
    compiled = jax.jit(lambda level, now, action: advance(level, now, action, params)[:2])
    return jax.tree.map(np.asarray, compiled(sample.level, now, sample.action))


@functools.cache
def episode_step(max_timesteps: int = 256):
    """Compile an env step with automatic reset."""
    params = TaskParams(max_timesteps=max_timesteps)
    return jax.jit(lambda level, now, action: step(level, now, action, params))


def lanes_of(tree, lanes):
    return jax.tree.map(lambda x: np.asarray(x)[..., lanes], tree)


def as_level(sample: Golden, lanes) -> Level:
    return lanes_of(sample.level, lanes)


@pytest.mark.parametrize("size", ["s", "m", "l"])
class TestAgainstTheReference:
    def test_reward_done_and_goal_equal_the_references(self, size: str) -> None:
        sample, (_, outcome) = golden(size), env_step(size)
        same = np.abs(outcome.reward - sample.reward) < 1e-4
        same &= (outcome.done == sample.done) & (outcome.goal == sample.goal)
        assert same.mean() >= 0.995, np.flatnonzero(~same)
        assert sample.goal.sum() > 40  # goals, failures and steps in between all occur
        assert (sample.reward < -0.5).sum() > 20
        assert (~sample.done).sum() > 300

    def test_advance_gives_the_references_next_state(self, size: str) -> None:
        sample, (after, _) = golden(size), env_step(size)
        worst = np.zeros(sample.reward.size)
        for name in ("position", "rotation", "velocity", "angular_velocity"):
            gap = np.abs(getattr(after.state, name) - getattr(sample.env_after, name))
            worst = np.maximum(worst, gap.reshape(-1, gap.shape[-1]).max(0))
        assert (worst < 1e-3).mean() >= 0.99, np.sort(worst)[-10:]  # two physics steps

    def test_clock_and_distance_equal_the_references(self, size: str) -> None:
        sample, (after, _) = golden(size), env_step(size)
        np.testing.assert_array_equal(after.timestep, sample.env_timestep)
        assert (np.abs(after.last_distance - sample.env_last_distance) < 1e-3).mean() >= 0.995


@functools.cache
def still() -> Level:
    """Return eight levels of size s, from golden states that do not end an episode."""
    sample = golden("s")
    return as_level(sample, np.flatnonzero(~sample.done & (sample.timestep < 200))[:8])


def actions(level: Level) -> np.ndarray:
    return np.full((6, level.role.shape[-1]), OFF, np.int32)


def test_episode_starts_from_the_level() -> None:
    level = still()
    fresh = reset(level)
    assert fresh.state is level.state
    assert (np.asarray(fresh.timestep) == 0).all()
    assert (np.asarray(fresh.last_distance) == NO_DISTANCE).all()


def test_first_step_has_no_shaping_reward() -> None:
    level = still()
    now, first = episode_step()(level, reset(level), actions(level))
    assert (np.asarray(first.reward)[~np.asarray(first.done)] == 0).all()
    assert (np.asarray(now.last_distance)[~np.asarray(first.done)] > 0).all()
    after, second = episode_step()(level, now, actions(level))
    expected = 0.1 * (np.asarray(now.last_distance) - np.asarray(after.last_distance))
    going = ~np.asarray(second.done)
    np.testing.assert_allclose(np.asarray(second.reward)[going], expected[going], atol=1e-6)


def test_time_limit_ends_and_restarts_an_episode() -> None:
    level = still()
    start = reset(level)
    late = dataclasses.replace(start, timestep=jnp.full_like(start.timestep, 255))
    now, outcome = episode_step()(level, late, actions(level))
    assert np.asarray(outcome.done).all()
    assert (np.asarray(now.timestep) == 0).all()
    assert (np.asarray(now.last_distance) == NO_DISTANCE).all()
    for ours, initial in zip(jax.tree.leaves(now.state), jax.tree.leaves(level.state), strict=True):
        np.testing.assert_array_equal(ours, initial)
    earlier = dataclasses.replace(start, timestep=jnp.full_like(start.timestep, 254))
    now, outcome = episode_step()(level, earlier, actions(level))
    assert not (np.asarray(outcome.done) & ~np.asarray(outcome.goal) & (np.asarray(outcome.reward) > -0.5)).any()
    assert (np.asarray(now.timestep)[~np.asarray(outcome.done)] == 255).all()


def test_nan_ends_only_its_own_episode() -> None:
    level = still()
    velocity = np.array(level.state.velocity)
    velocity[5, 0, 2] = np.nan
    broken = dataclasses.replace(reset(level), state=dataclasses.replace(level.state, velocity=velocity))
    now, outcome = episode_step()(level, broken, actions(level))
    _, unharmed = episode_step()(level, reset(level), actions(level))
    others = np.arange(8) != 2
    assert np.asarray(outcome.done)[2]
    assert not np.asarray(outcome.goal)[2]
    assert np.isfinite(np.asarray(outcome.reward)).all()
    assert not np.asarray(has_nan(now.state)).any()  # restarted
    np.testing.assert_array_equal(np.asarray(outcome.done)[others], np.asarray(unharmed.done)[others])
    np.testing.assert_array_equal(np.asarray(outcome.reward)[others], np.asarray(unharmed.reward)[others])


def test_restart_changes_only_lanes_that_are_done() -> None:
    level = still()
    now = dataclasses.replace(reset(level), timestep=jnp.arange(8, dtype=jnp.int32) + 1)
    done = jnp.arange(8) % 2 == 0
    np.testing.assert_array_equal(restart(level, now, done).timestep, np.where(done, 0, now.timestep))


def with_roles(level: Level, roles: dict[int, Role], active: bool = True) -> Level:
    """Give all bodies the role plain except for `roles`; make all active or none."""
    role = np.full_like(level.role, Role.PLAIN)
    for body, value in roles.items():
        role[body] = value
    flags = np.full_like(level.model.active, active)
    return dataclasses.replace(level, role=role, model=dataclasses.replace(level.model, active=flags))


def contacts_with(level: Level, contact: int | None) -> Manifold:
    """Return a manifold with at most one contact."""
    contacts, lanes = pairs_of(level.size).contacts, level.role.shape[-1]
    active = np.zeros((contacts, lanes), bool)
    if contact is not None:
        active[contact] = True
    return jnp.asarray(active)


def pair_contacts(level: Level) -> list[tuple[int, int, int, bool]]:
    """Return (contact, body a, body b, whether the task checks it) of every contact."""
    pairs = pairs_of(level.size)
    polygon = list(zip(pairs.polygon.a, pairs.polygon.b, strict=True))
    others = [pair for kind in (pairs.circle_polygon, pairs.circle) for pair in zip(kind.a, kind.b, strict=True)]
    rows = [(a, b, True) for a, b in polygon] + [(a, b, False) for a, b in polygon] + [(a, b, True) for a, b in others]
    return [(number, *row) for number, row in enumerate(rows)]


@pytest.mark.parametrize("first", list(Role))
@pytest.mark.parametrize("second", list(Role))
def test_touches_follows_the_roles(first: Role, second: Role) -> None:
    """Green with blue is the goal, green with red a failure; other pairs of roles have no effect."""
    one = as_level(golden("s"), slice(0, 1))
    for contact, a, b, counts in pair_contacts(one):
        level, active = with_roles(one, {a: first, b: second}), contacts_with(one, contact)
        goal = bool(touches(level, active, Role.GREEN, Role.BLUE)[0])
        fail = bool(touches(level, active, Role.GREEN, Role.RED)[0])
        assert goal == (counts and {first, second} == {Role.GREEN, Role.BLUE}), (contact, a, b)
        assert fail == (counts and {first, second} == {Role.GREEN, Role.RED}), (contact, a, b)


def test_touches_ignores_roles_of_inactive_bodies() -> None:
    one = as_level(golden("s"), slice(0, 1))
    contact, a, b, _ = pair_contacts(one)[-1]
    asleep = with_roles(one, {a: Role.GREEN, b: Role.BLUE}, active=False)
    assert not touches(asleep, contacts_with(one, contact), Role.GREEN, Role.BLUE)[0]
    assert not has_roles(asleep, [a], [b], Role.GREEN, Role.BLUE).any()
    assert goal_distance(asleep, asleep.state)[0] == 0


def test_goal_distance_sums_over_pairs_of_centres() -> None:
    one = as_level(golden("s"), slice(0, 1))
    level = with_roles(one, {4: Role.BLUE, 5: Role.GREEN, 6: Role.BLUE})
    place = np.asarray(level.state.position)[..., 0]
    expected = np.linalg.norm(place[5] - place[4]) + np.linalg.norm(place[5] - place[6])
    np.testing.assert_allclose(goal_distance(level, level.state)[0], expected, rtol=1e-6)


def test_touching_red_and_blue_at_once_fails() -> None:
    """Green touching both in the same physics step does not reach the goal."""
    sample = golden("s")
    pairs = pairs_of(sample.level.size)
    n, m = len(pairs.polygon), len(pairs.circle_polygon)
    at = 2 * n + list(zip(pairs.circle_polygon.a, pairs.circle_polygon.b, strict=True)).index((5, 0))
    circles = 2 * n + m
    both = np.flatnonzero(sample.after.contact_active[at] & sample.after.contact_active[circles])
    assert len(both) > 3  # circle 5 touches the floor and the other circle
    level = with_roles(as_level(sample, both), {5: Role.GREEN, 0: Role.RED, 6: Role.BLUE})
    _, outcome = episode_step()(level, reset(level), np.zeros((6, len(both)), np.int32))
    assert np.asarray(outcome.done).all()
    assert not np.asarray(outcome.goal).any()
    np.testing.assert_array_equal(outcome.reward, -1.0)
    level = with_roles(as_level(sample, both), {5: Role.GREEN, 6: Role.BLUE})
    _, outcome = episode_step()(level, reset(level), np.zeros((6, len(both)), np.int32))
    assert np.asarray(outcome.goal).all()
    np.testing.assert_array_equal(outcome.reward, 1.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frame_skip": 0}, "frame_skip is 0"),
        ({"max_timesteps": 0}, "max_timesteps"),
        ({"dense_reward_scale": -1.0}, "dense_reward_scale is -1.0"),
        ({"dense_reward_scale": 1e7}, "dense_reward_scale is 10000000.0"),
    ],
)
def test_task_params_refuse_impossible_rules(change: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        TaskParams(**change)
