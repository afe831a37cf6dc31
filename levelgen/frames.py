"""Points in the frames of bodies and in the world, as numpy arrays of one lane without its axis."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from levelproof.physics.types import State


def turned(points: ArrayLike, angle: Any) -> np.ndarray:
    """Rotate points (..., 2) about the origin by an angle, rad: one for all points, or one each."""
    points, cos, sin = np.asarray(points), np.cos(angle), np.sin(angle)
    return np.stack([points[..., 0] * cos - points[..., 1] * sin, points[..., 0] * sin + points[..., 1] * cos], -1)


def in_world(state: State, body: Any, points: ArrayLike) -> np.ndarray:
    """Transform points (..., 2) from the frame of a body (one for all, or one each) to the world, m."""
    return np.asarray(state.position)[body] + turned(points, np.asarray(state.rotation)[body])
