"""Reads golden observations (see make_observations.py), lanes last, and compares ours with them."""

from dataclasses import dataclass

import jax
import numpy as np

from levelproof.levelgen.level import Level
from tests.golden.load import HERE, golden

DIGITS = 8


@dataclass(frozen=True)
class Seen:
    """What the reference makes of the first golden states of a size."""

    level: Level  # its `state` is the state that is seen
    fields: dict[str, np.ndarray]  # of the file, lanes last

    def palette_image(self, lane: int) -> np.ndarray:
        """(x, y, 3) colours of 0 to 255."""
        return self.fields["palette"].T[self.fields["image"][..., lane]]


def load_seen(size: str) -> Seen:
    with np.load(HERE / f"seen_{size}.npz") as file:
        fields = {name: np.moveaxis(file[name], 0, -1) for name in file.files if name != "about"}
    lanes = fields["image"].shape[-1]
    return Seen(jax.tree.map(lambda x: x[..., :lanes], golden(size).level), fields)


def assert_seen(fields: dict[str, np.ndarray], name: str, ours: np.ndarray) -> None:
    """Numbers agree in the states kept in full, and their weighted sums in all; other kinds agree everywhere."""
    expected = fields[name]
    if ours.dtype.kind != "f":
        np.testing.assert_array_equal(ours, expected)
        return
    np.testing.assert_allclose(ours[..., : expected.shape[-1]], expected, rtol=1e-5, atol=1e-5)
    rows = ours.reshape(-1, ours.shape[-1]).astype(np.float64)
    weights = np.random.default_rng(len(rows)).standard_normal((len(rows), DIGITS))
    scale = np.abs(weights).T @ np.abs(rows) + 1
    assert (np.abs(weights.T @ rows - fields[f"digest/{name}"]) / scale).max() < 1e-6
