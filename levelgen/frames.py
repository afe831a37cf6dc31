"""Points in the frames of bodies and in the world, as numpy arrays of one lane without its axis."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from levelproof.physics.types import State


def turned(points: ArrayLike, angle: Any) -> np.ndarray:
    """Points (..., 2) turned about the origin by an angle in radians, one for all or one each."""
    points, cos, sin = np.asarray(points), np.cos(angle), np.sin(angle)
    return np.stack([points[..., 0] * cos - points[..., 1] * sin, points[..., 0] * sin + points[..., 1] * cos], -1)


def in_world(state: State, body: Any, points: ArrayLike) -> np.ndarray:
    """Points (..., 2) in the frame of a body, or each in its own body's, where they are in the world, m."""
    return np.asarray(state.position)[body] + turned(points, np.asarray(state.rotation)[body])
