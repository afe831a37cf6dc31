"""Pixels against the reference's in 512 states per size, and what they must show."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.levelgen.level import Level
from levelproof.levelgen.task.observe.pixels import SIDE, pixels
from tests.golden.load_seen import load_seen
from tests.quick import jit_once


def draw(level: Level) -> np.ndarray:
    """Draw each lane: (lane, x, y, 3), from 0 to 255."""
    image = jit_once(jax.vmap(lambda level: pixels(level, level.state).image, in_axes=-1))(level)
    return 255 * np.asarray(image)


@pytest.mark.parametrize(
    "size", ["s", pytest.param("m", marks=pytest.mark.slow), pytest.param("l", marks=pytest.mark.campaign)]
)
def test_pixels_equal_the_references(size: str) -> None:
    seen = load_seen(size)
    ours = draw(seen.level)
    theirs = np.stack([seen.palette_image(lane) for lane in range(len(ours))]).astype(np.float32)
    assert ours.shape == (512, SIDE, SIDE, 3) == theirs.shape
    off = np.abs(ours - theirs).mean((1, 2, 3))
    assert off.mean() < 0.2
    assert off.max() < 2  # of 255, in the worst picture


def test_pixels_without_active_bodies_show_the_floor_only() -> None:
    level = jax.tree.map(lambda x: x[..., :8], load_seen("m").level)
    off = {name: np.zeros_like(getattr(level.model, name)) for name in ("active", "joint_active", "thruster_active")}
    bare = draw(dataclasses.replace(level, model=dataclasses.replace(level.model, **off)))
    assert (bare[:, :, 12:] == 255).all()  # above the floor, which is always drawn
    assert (bare[:, :, :10] < 255).any(-1).all()


def test_pixels_of_a_broken_world_omit_nan_bodies() -> None:
    level = jax.tree.map(lambda x: x[..., :2], load_seen("s").level)
    lost = jnp.asarray(level.state.position).at[4:].set(jnp.nan)
    state = dataclasses.replace(level.state, position=lost)
    assert np.isfinite(draw(dataclasses.replace(level, state=state))).all()
