"""Children of levels by random edits: they are valid levels, reproducible, and playable ones start calmly."""

from contextlib import suppress
from dataclasses import replace

import jax
import numpy as np
import pytest

from levelproof.levelgen.edit import EditError, set_role
from levelproof.levelgen.files.level_file import LevelFile, from_document, to_document
from levelproof.levelgen.level import SIZES, Level, Role
from levelproof.levelgen.mutate import DRAWS, MAX_SPEED, child_of, children_of, playable
from levelproof.levelgen.proofs import stay_idle
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES
from tests.quick import jit_once

pytestmark = pytest.mark.slow

idle = jit_once(stay_idle, static_argnames=("rules", "env_steps"))


def same(a: Level, b: Level) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


@pytest.mark.parametrize("size", SIZES)
def test_children_are_levels_that_a_file_holds(size: str) -> None:
    parents = sample_levels(np.arange(24), size)
    rng = np.random.default_rng(0)
    for i in range(24):
        child = child_of(parents[i], rng, edits=4)
        back = from_document(to_document(LevelFile(child, DEFAULT_RULES))).level  # finds flaws, too
        assert np.array_equal(np.asarray(back.model.collides), np.asarray(child.model.collides))


@pytest.mark.parametrize("draw", DRAWS, ids=lambda draw: draw.__name__.strip("_"))
def test_every_edit_changes_some_levels(draw) -> None:
    parents = sample_levels(np.arange(40), "m")
    rng, changed = np.random.default_rng(0), 0
    for i in range(40):
        with suppress(EditError):
            changed += not same(draw(parents[i], rng), parents[i])
    assert changed >= 4


def test_children_depend_on_the_generator_alone() -> None:
    parents = sample_levels(np.arange(8), "s")
    one, two, other = (children_of(parents, np.random.default_rng(seed), 2, DEFAULT_RULES)[0] for seed in (3, 3, 4))
    assert same(one, two)
    assert not same(one, other)
    assert same(children_of(parents, np.random.default_rng(3), 0, DEFAULT_RULES)[0], parents)


def test_playable_children_have_a_goal_and_start_calmly() -> None:
    children, good = children_of(sample_levels(np.arange(64), "s"), np.random.default_rng(0), 3, DEFAULT_RULES)
    assert 0.3 < good.mean() < 1
    ended = idle(children, DEFAULT_RULES, 1)
    assert not np.asarray(ended.reaches | ended.fails | ended.breaks)[good].any()
    roles = np.where(children.model.active, children.role, Role.PLAIN)
    assert ((roles == Role.GREEN).any(0) & (roles == Role.BLUE).any(0))[good].all()


def test_levels_without_a_goal_or_with_overlaps_are_not_playable() -> None:
    level = sample_levels(np.array([0]), "s")[0]
    assert np.asarray(playable(level, DEFAULT_RULES)).all()
    body = int(np.flatnonzero(np.asarray(level.role)[:, 0] == Role.GREEN)[0])
    assert not np.asarray(playable(set_role(level, body, Role.PLAIN), DEFAULT_RULES)).any()
    position, velocity = (np.asarray(x).copy() for x in (level.state.position, level.state.velocity))
    position[body, 0], velocity[body, 0] = -0.1, 2 * MAX_SPEED
    unpowered = {name: 0 * getattr(level.model, name) for name in ("motor_power", "thruster_power")}
    for spoiled in (
        replace(level, role=np.where(np.asarray(level.role) == Role.BLUE, Role.PLAIN, level.role)),
        replace(level, model=replace(level.model, **unpowered)),
        replace(level, state=replace(level.state, position=position)),
        replace(level, state=replace(level.state, velocity=velocity)),
    ):
        assert not np.asarray(playable(spoiled, DEFAULT_RULES)).any()
    levels = sample_levels(np.arange(64), "s")
    onto_each_other = np.asarray(levels.state.position).copy()
    onto_each_other[4:] = onto_each_other[4:5] + 0.01 * np.arange(len(onto_each_other) - 4)[:, None, None]
    crowded = replace(levels, state=replace(levels.state, position=onto_each_other))
    before, after = (np.asarray(playable(each, DEFAULT_RULES)).mean() for each in (levels, crowded))
    assert after < before / 2
