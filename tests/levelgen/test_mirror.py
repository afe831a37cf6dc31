"""Mirror images of levels: mirroring twice restores a level, physics agrees, and most witnesses survive."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import levelproof
from levelproof.experts.witness.witness import replay, succeeds
from levelproof.levelgen.level import WORLD_SIDE, Level
from levelproof.levelgen.mirror import mirror, mirror_actions
from levelproof.physics.types import FIXED_POLYGONS

COUNT, STEPS = 64, 12


@pytest.fixture(scope="module")
def levels() -> Level:
    return jax.device_get(levelproof.sample_levels(np.arange(COUNT), "s"))


def actions() -> np.ndarray:
    """Random actions [256, 6, level], each held for 16 steps."""
    drawn = np.random.default_rng(0).integers(0, (3, 3, 3, 3, 2, 2), (16, COUNT, 6))
    return np.repeat(drawn, 16, 0).transpose(0, 2, 1).astype(np.int32)


def test_mirroring_twice_restores_the_level(levels: Level) -> None:
    image = mirror(levels)
    for once, twice in zip(jax.tree.leaves(levels), jax.tree.leaves(mirror(image)), strict=True):
        np.testing.assert_allclose(np.asarray(twice, float), np.asarray(once, float), atol=1e-6)
    moved = np.abs(image.state.position - levels.state.position)[FIXED_POLYGONS:, 0].max(0)
    assert (moved > 1e-3).all()
    given = actions()
    np.testing.assert_array_equal(mirror_actions(mirror_actions(given.transpose(0, 2, 1))), given.transpose(0, 2, 1))


def test_what_is_attached_to_a_wall_changes_walls() -> None:
    """As some joints of sampled levels of l are."""
    levels = jax.device_get(levelproof.sample_levels(np.arange(2048), "l"))
    joined = levels.model.joint_active & ((levels.model.joint_a == 1) | (levels.model.joint_a == 2))
    levels = levels[joined.any(0)]
    assert len(levels) > 3
    image = mirror(levels)
    ends = [np.stack(anchors_in_world(each)) for each in (levels, image)]
    expected = ends[0] * np.array([-1, 1])[:, None] + np.array([WORLD_SIDE, 0])[:, None]
    off = np.where(levels.model.joint_active[None, :, None], np.abs(expected - ends[1]), 0)
    assert off.max() < 1e-5
    assert (image.model.joint_a[levels.model.joint_a == 1] == 2).all()
    assert (image.model.collides[1] == levels.model.collides[2][[0, 2, 1, *range(3, levels.size.bodies)]]).all()
    one_wall = np.array(levels.model.active)
    one_wall[1] = False
    without = mirror(replace(levels, model=replace(levels.model, active=one_wall)))
    assert not without.model.active[2].any()
    assert without.model.active[1].all()
    impulses = np.random.default_rng(0).normal(size=levels.state.joint_impulse.shape).astype(np.float32)
    moving = replace(levels, state=replace(levels.state, joint_impulse=impulses, joint_angular_impulse=impulses[:, 0]))
    state = mirror(moving).state
    np.testing.assert_array_equal(state.joint_impulse, impulses * [[-1], [1]])
    np.testing.assert_array_equal(state.joint_angular_impulse, -impulses[:, 0])


def anchors_in_world(level: Level) -> list[np.ndarray]:
    """Return where both bodies of every joint have its anchor [joint, 2, lane]; they meet."""
    ends = []
    for body, anchor in (
        (level.model.joint_a, level.model.joint_anchor_a),
        (level.model.joint_b, level.model.joint_anchor_b),
    ):
        turn = np.take_along_axis(np.asarray(level.state.rotation), body, 0)
        x, y = anchor[:, 0], anchor[:, 1]
        turned = np.stack([np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y], 1)
        ends.append(turned + np.take_along_axis(np.asarray(level.state.position), body[:, None], 0))
    return ends


def test_physics_of_the_image_is_the_image_of_the_physics(levels: Level) -> None:
    """For a few steps; then bodies touch, and differences in rounding and in the solver's order grow."""
    given = actions()
    image = mirror_actions(given.transpose(0, 2, 1)).transpose(0, 2, 1)
    record, other = replay(levels, given), replay(mirror(levels), image)
    moves = levels.model.active & (levels.model.inverse_mass != 0)
    x, y = (np.asarray(each.state.position)[STEPS] for each in (record, other))
    off = np.abs(np.stack([WORLD_SIDE - x[:, 0] - y[:, 0], x[:, 1] - y[:, 1]])).max(0)
    alike = np.where(moves, off, 0).max(0) < 1e-2
    assert alike.mean() > 0.9
    spun = np.asarray(record.state.angular_velocity)[STEPS] + np.asarray(other.state.angular_velocity)[STEPS]
    assert (np.where(moves, np.abs(spun), 0).max(0)[alike] < 0.5).mean() > 0.95


def test_most_successes_survive_mirroring(levels: Level) -> None:
    given = actions()
    image = mirror_actions(given.transpose(0, 2, 1)).transpose(0, 2, 1)
    both = [replay(*pair) for pair in ((levels, given), (mirror(levels), image))]
    solved, survived = (succeeds(record.done, record.goal) for record in both)
    assert solved.sum() > 10
    assert survived[solved].mean() > 0.8
