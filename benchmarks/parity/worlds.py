"""Batches of worlds on the host: numpy trees of our types, lanes last, in blocks of equal size."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TypeVar

import jax
import numpy as np
from jaxtyping import Float, Float32, Shaped

from levelproof.levelgen.files.kinetix import state_from_kinetix
from levelproof.levelgen.level import Level
from levelproof.physics.pairs import pairs_of
from levelproof.physics.types import Size, State

BLOCK = 256  # lanes of every program of both engines, which limits compilations
T = TypeVar("T")


def lanes_of(tree: T, lanes) -> T:
    """Take lanes of a tree."""
    return jax.tree.map(lambda x: np.ascontiguousarray(np.asarray(x)[..., lanes]), tree)


def joined(trees: Sequence[T]) -> T:
    """Concatenate batches."""
    return jax.tree.map(lambda *xs: np.concatenate(xs, -1), *trees)


def starting_in(level: Level, state: State) -> Level:
    """Replace a level's initial state."""
    return dataclasses.replace(level, state=state)


def contact_bodies(size: Size) -> tuple[np.ndarray, np.ndarray]:
    """Return both bodies of each contact, in the order of physics/pairs.py."""
    pairs = pairs_of(size)
    kinds = (pairs.polygon, pairs.polygon, pairs.circle_polygon, pairs.circle)
    a, b = (np.array([body for kind in kinds for body in getattr(kind, end)], int) for end in "ab")
    return a, b


def record_from_kinetix(fields: Mapping[str, Shaped[np.ndarray, "step lane ..."]]) -> State:
    """Convert the reference's states (step, lane, ...) to ours, [..., step, lane]."""
    steps, lanes = fields["polygon/rotation"].shape[:2]
    flat = state_from_kinetix({name: x.reshape(steps * lanes, *x.shape[2:]) for name, x in fields.items()})
    return jax.tree.map(lambda x: x.reshape(*x.shape[:-1], steps, lanes), flat)


def nudged(
    values: Float[np.ndarray, "*shape"], rng: np.random.Generator, most: int = 1
) -> Float32[np.ndarray, "*shape"]:
    """Perturb each number by at most `most` units in its last place; zeros stay."""
    moves = rng.integers(-most, most + 1, values.shape)
    out = values.astype(np.float32)
    for k in range(1, most + 1):
        towards = np.where(moves > 0, np.inf, -np.inf).astype(np.float32)
        out = np.where(np.abs(moves) >= k, np.nextafter(out, towards), out)
    return np.where(values == 0, values, out).astype(np.float32)


def nudged_tree(tree: T, rng: np.random.Generator, most: int = 1) -> T:
    """Perturb every float of a tree, as `nudged` does."""
    move = lambda x: nudged(x, rng, most) if np.asarray(x).dtype.kind == "f" else x
    return jax.tree.map(move, tree)
