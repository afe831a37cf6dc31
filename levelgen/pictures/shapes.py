"""Elements of a picture: SVG shapes, parts that move, scenes, and the width of text.

Lengths are metres, y points up, angles are radians.
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
Host = np.ndarray | jax.Array  # arrays of levels and states, read or computed
LETTERS = 100  # font units per metre: browsers round small font sizes
MIDDLE = 0.37  # height of a letter's middle above the baseline, in font sizes


@dataclass(frozen=True)
class Part:
    """Elements that move together, in their own frame; shapes "" mean that the part is hidden now."""

    shapes: str
    position: Point = (0.0, 0.0)
    angle: float = 0.0


@dataclass(frozen=True)
class Scene:
    """The parts of a picture, the last one on top."""

    parts: tuple[Part, ...]
    title: str
    footer: float  # m of picture below the world


def polygon(
    points: Sequence[Point] | Host, fill: Colour, edge: Colour | None = None, width: float = EDGE, hatched: bool = False
) -> str:
    """Draw a filled polygon, with a line around it if it has an edge colour."""
    return _filled(f'polygon points="{_points(points)}"', fill, edge, width, hatched)


def disc(centre: Point, radius: float, fill: Colour, edge: Colour, hatched: bool = False) -> str:
    """Draw a filled circle; its edge lies within the radius."""
    width = min(EDGE, radius)
    circle = f'circle cx="{digits(centre[0])}" cy="{digits(centre[1])}" r="{digits(radius - width / 2)}"'
    return _filled(circle, fill, edge, width, hatched)


def _filled(shape: str, fill: Colour, edge: Colour | None, width: float, hatched: bool) -> str:
    below = f'<{shape} fill="rgb{fill}"/>' if hatched else ""
    paint = f"url(#{HATCHING})" if hatched else f"rgb{fill}"
    return f'{below}<{shape}{_stroke(edge, width) if edge else ""} fill="{paint}"/>'


def line(points: Sequence[Point] | Host, colour: Colour, width: float) -> str:
    """Draw straight lines from point to point."""
    return f'<polyline points="{_points(points)}" fill="none"{_stroke(colour, width)}/>'


def rectangle(low: Point, high: Point, fill: Colour, corner: float = 0.0) -> str:
    """Draw an upright rectangle without an edge; `corner`: radius of its corners."""
    (x, y), (width, height) = map(digits, low), (digits(b - a) for a, b in zip(low, high, strict=True))
    return f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="{digits(corner)}" fill="rgb{fill}"/>'


def text(position: Point, words: str, colour: Colour, size: float, ends: bool = False) -> str:
    """Draw words that start (or end, if `ends`) at a position, vertically centred; `text_width` wide in any font."""
    x, y = digits(position[0]), digits(position[1] - MIDDLE * size)
    width, anchor = digits(LETTERS * text_width(words, size)), ' text-anchor="end"' if ends else ""
    return (
        f'<text transform="translate({x},{y}) scale({1 / LETTERS},{-1 / LETTERS})" font-size="{digits(LETTERS * size)}"'
        f'{anchor} textLength="{width}" lengthAdjust="spacingAndGlyphs" fill="rgb{colour}">{escape(words)}</text>'
    )


def _stroke(colour: Colour, width: float) -> str:
    return f' stroke="rgb{colour}" stroke-width="{digits(width)}"'


def _points(points: Sequence[Point] | Host) -> str:
    return " ".join(f"{digits(x)},{digits(y)}" for x, y in np.asarray(points))


def digits(value: float) -> str:
    """Format a number to a tenth of a millimetre, without trailing zeros."""
    words = f"{value:.4f}".rstrip("0").rstrip(".")
    return "0" if words == "-0" else words


@cache
def font() -> ImageFont.FreeTypeFont:
    """Return the font of all pictures: Pillow's own."""
    letters = ImageFont.load_default(LETTERS)
    assert isinstance(letters, ImageFont.FreeTypeFont)
    return letters


def text_width(words: str, size: float) -> float:
    """Return the width of words in a font size, m."""
    return font().getlength(words) * size / LETTERS
