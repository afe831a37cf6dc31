"""Mirror images of levels: mirroring twice restores a level, physics agrees, and most witnesses survive."""

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
