"""What a picture consists of, whoever draws it: shapes in parts that move, and how wide words are.

Lengths are metres, y is upwards, angles are radians.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import jax
import numpy as np
from PIL import ImageFont

from levelgen.level import WORLD_SIDE
from levelgen.pictures.style import BORDER, EDGE, HEADER, Colour

Point = tuple[float, float]
Points = tuple[Point, ...]
Host = np.ndarray | jax.Array  # levels and states that were read or computed


@dataclass(frozen=True)
class Polygon:
    """A filled polygon, with a line around it if it has an edge."""

    points: Points
    fill: Colour
    edge: Colour | None = None
    width: float = EDGE
    hatched: bool = False  # in the colour of its edge


@dataclass(frozen=True)
class Disc:
    """A filled circle; its edge lies within the radius."""

    centre: Point
    radius: float
    fill: Colour
    edge: Colour
    hatched: bool = False


@dataclass(frozen=True)
class Line:
    """Straight from point to point."""

    points: Points
    colour: Colour
    width: float


@dataclass(frozen=True)
class Rectangle:
    """An upright rectangle without an edge."""

    low: Point
    high: Point
    fill: Colour
    corner: float = 0.0  # radius of its corners


@dataclass(frozen=True)
class Text:
    """Words that begin or end at a position, half of their height above it."""

    position: Point
    words: str
    colour: Colour
    size: float
    ends: bool = False  # at the position; otherwise they begin there


Shape = Polygon | Disc | Line | Rectangle | Text


@dataclass(frozen=True)
class Part:
    """Shapes that move together, in a frame of their own. No shapes: the part does not show now."""

    shapes: tuple[Shape, ...]
    position: Point = (0.0, 0.0)
    angle: float = 0.0  # of parts without rectangles and words


@dataclass(frozen=True)
class Scene:
    """What is drawn, the last part on top."""

    parts: tuple[Part, ...]
    title: str
    footer: float  # m of picture below the world

    @property
    def top(self) -> float:
        """Height of the picture's upper edge above the world's lower one, m."""
        return WORLD_SIDE + BORDER + HEADER


def turned(points: Sequence[Point] | Host, angle: float) -> np.ndarray:
    """Points (..., 2) turned about the origin by an angle in radians."""
    points, cos, sin = np.asarray(points), np.cos(angle), np.sin(angle)
    return np.stack([points[..., 0] * cos - points[..., 1] * sin, points[..., 0] * sin + points[..., 1] * cos], -1)


def placed(points: Sequence[Point], part: Part) -> np.ndarray:
    """Points (point, 2) of a part's frame, in the world."""
    return turned(points, part.angle) + np.asarray(part.position)


@cache
def font(pixels: int) -> ImageFont.FreeTypeFont:
    """The letters of all pictures."""
    letters = ImageFont.load_default(pixels)
    assert isinstance(letters, ImageFont.FreeTypeFont)  # Pillow's own is one
    return letters


def text_width(words: str, size: float) -> float:
    """Of words in letters of a size, m."""
    return font(100).getlength(words) * size / 100


def text_drop(size: float) -> float:
    """How far the middle of letters of a size is above the line that they stand on, m."""
    ascent, descent = font(100).getmetrics()
    return (ascent - descent) / 2 * size / 100
