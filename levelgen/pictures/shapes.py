"""What a picture consists of: SVG elements in parts that move, and how wide words are.

Lengths are metres, y is upwards, angles are radians.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from xml.sax.saxutils import escape

import jax
import numpy as np
from PIL import ImageFont

from levelproof.levelgen.pictures.style import EDGE, HATCHING, Colour

Point = tuple[float, float]
Host = np.ndarray | jax.Array  # levels and states that were read or computed
LETTERS = 100  # units per metre where letters are drawn: browsers round the sizes of small ones
MIDDLE = 0.37  # of their size, that the middle of letters is above the line they stand on


@dataclass(frozen=True)
class Part:
    """Elements that move together, in a frame of their own. "": the part does not show now."""

    shapes: str
    position: Point = (0.0, 0.0)
    angle: float = 0.0


@dataclass(frozen=True)
class Scene:
    """What is drawn, the last part on top."""

    parts: tuple[Part, ...]
    title: str
    footer: float  # m of picture below the world


def polygon(
    points: Sequence[Point] | Host, fill: Colour, edge: Colour | None = None, width: float = EDGE, hatched: bool = False
) -> str:
    """Filled, with a line around it if it has an edge."""
    return _filled(f'polygon points="{_points(points)}"', fill, edge, width, hatched)


def disc(centre: Point, radius: float, fill: Colour, edge: Colour, hatched: bool = False) -> str:
    """A filled circle; its edge lies within the radius."""
    circle = f'circle cx="{number(centre[0])}" cy="{number(centre[1])}" r="{number(radius - EDGE / 2)}"'
    return _filled(circle, fill, edge, EDGE, hatched)


def _filled(shape: str, fill: Colour, edge: Colour | None, width: float, hatched: bool) -> str:
    below = f'<{shape} fill="rgb{fill}"/>' if hatched else ""
    paint = f"url(#{HATCHING})" if hatched else f"rgb{fill}"
    return f'{below}<{shape}{_stroke(edge, width) if edge else ""} fill="{paint}"/>'


def line(points: Sequence[Point] | Host, colour: Colour, width: float) -> str:
    """Straight from point to point."""
    return f'<polyline points="{_points(points)}" fill="none"{_stroke(colour, width)}/>'


def rectangle(low: Point, high: Point, fill: Colour, corner: float = 0.0) -> str:
    """Upright, without an edge; `corner`: radius of its corners."""
    (x, y), (width, height) = map(number, low), (number(b - a) for a, b in zip(low, high, strict=True))
    return f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="{number(corner)}" fill="rgb{fill}"/>'


def text(position: Point, words: str, colour: Colour, size: float, ends: bool = False) -> str:
    """Words that begin or end at a position, half of their height above it; as wide as `text_width` in any letters."""
    x, y = number(position[0]), number(position[1] - MIDDLE * size)
    width, anchor = number(LETTERS * text_width(words, size)), ' text-anchor="end"' if ends else ""
    return (
        f'<text transform="translate({x},{y}) scale({1 / LETTERS},{-1 / LETTERS})" font-size="{number(LETTERS * size)}"'
        f'{anchor} textLength="{width}" lengthAdjust="spacingAndGlyphs" fill="rgb{colour}">{escape(words)}</text>'
    )


def _stroke(colour: Colour, width: float) -> str:
    return f' stroke="rgb{colour}" stroke-width="{number(width)}"'


def _points(points: Sequence[Point] | Host) -> str:
    return " ".join(f"{number(x)},{number(y)}" for x, y in np.asarray(points))


def number(value: float) -> str:
    """In as few letters as a tenth of a millimetre takes."""
    words = f"{value:.4f}".rstrip("0").rstrip(".")
    return "0" if words == "-0" else words


@cache
def font() -> ImageFont.FreeTypeFont:
    """The letters of all pictures: Pillow's own."""
    letters = ImageFont.load_default(LETTERS)
    assert isinstance(letters, ImageFont.FreeTypeFont)
    return letters


def text_width(words: str, size: float) -> float:
    """Of words in letters of a size, m."""
    return font().getlength(words) * size / LETTERS
