"""Scenes as vectors: a picture or a film in one SVG file, with the shapes that `raster.py` rasterises.

A film is one drawing whose parts move: what a part does becomes SMIL animations, which browsers play in a loop.
Programs that do not play them show the first scene.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import accumulate
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from levelgen.level import WORLD_SIDE
from levelgen.pictures.shapes import (
    Disc,
    Line,
    Part,
    Point,
    Polygon,
    Rectangle,
    Scene,
    Shape,
    Text,
    placed,
    text_drop,
    text_width,
)
from levelgen.pictures.style import (
    BORDER,
    EDGE,
    HATCH_PITCH,
    HATCH_WIDTH,
    PAPER,
    Colour,
)

WIDTH = 480  # user units, of a picture
SCALE = WIDTH / (WORLD_SIDE + 2 * BORDER)  # units per metre
FONTS = "Aileron, Helvetica, Arial, sans-serif"

ToPage = Callable[[Sequence[Point]], np.ndarray]  # from a part's metres to units, (point, 2)


def write_svg(scenes: Sequence[Scene], path: Path, seconds: Sequence[float]) -> None:
    """A film that repeats, each scene shown for its seconds; of one scene, a picture."""
    path.write_text(svg_of(scenes, seconds), encoding="utf-8")


def svg_of(scenes: Sequence[Scene], seconds: Sequence[float]) -> str:
    """The text of the file. The scenes are of one level."""
    first, clock = scenes[0], Clock.of(seconds)
    height = _number((first.top + first.footer) * SCALE)
    parts = [_part(states, first.top, clock) for states in zip(*(scene.parts for scene in scenes), strict=True)]
    size = f'width="{WIDTH}" height="{height}" viewBox="0 0 {WIDTH} {height}"'
    edges = {
        shape.edge
        for part in first.parts
        for shape in part.shapes
        if isinstance(shape, Polygon | Disc) and shape.hatched and shape.edge
    }
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img" font-family="{FONTS}" stroke-linejoin="round">',
            f"<title>{escape(first.title)}</title>",
            f"<defs>{''.join(map(_hatching, sorted(edges)))}</defs>",
            f'<rect width="{WIDTH}" height="{height}" fill="{_colour(PAPER)}"/>',
            *filter(None, parts),
            "</svg>\n",
        ]
    )


@dataclass(frozen=True)
class Clock:
    """When the scenes of a film begin."""

    starts: tuple[float, ...]  # shares of its length
    length: float  # s

    @classmethod
    def of(cls, seconds: Sequence[float]) -> "Clock":
        *ends, length = accumulate(seconds)
        return cls(tuple(end / length for end in (0.0, *ends)), length)

    def animate(self, tag: str, values: Sequence[str], smooth: bool) -> str:
        """An element that makes its parent follow one value a scene; of equal ones in a row, the ends alone."""
        last = len(values) - 1
        keep = [
            i
            for i, value in enumerate(values)
            if i in (0, last) or values[i - 1] != value or (smooth and values[i + 1] != value)
        ]
        times, chosen = [_number(self.starts[i], 5) for i in keep], [values[i] for i in keep]
        if smooth:  # the last scene stands still until the end
            times, chosen = [*times, "1"], [*chosen, chosen[-1]]
        mode = "" if smooth else ' calcMode="discrete"'
        return (
            f'<{tag} dur="{_number(self.length, 3)}s" repeatCount="indefinite"{mode} '
            f'keyTimes="{";".join(times)}" values="{";".join(chosen)}"/>'
        )


def _part(states: Sequence[Part], top: float, clock: Clock) -> str:
    """All that a part does: where it is in each scene, and which shapes it shows."""
    poses = [(state.position, state.angle) for state in states]
    moves = len(set(poses)) > 1
    to_page: ToPage = lambda points: np.array(points) * (SCALE, -SCALE)
    if not moves:
        to_page = lambda points: _in_page(placed(points, states[0]), top)
    looks = list(dict.fromkeys(state.shapes for state in states if state.shapes))
    drawn = []
    for look in looks:
        shapes = "".join(_shape(shape, to_page) for shape in look)
        shown = ["visible" if state.shapes == look else "hidden" for state in states]
        if "hidden" in shown:
            timing = clock.animate('animate attributeName="visibility"', shown, smooth=False)
            shapes = f'<g visibility="{shown[0]}">{timing}{shapes}</g>'
        drawn.append(shapes)
    if not moves or not drawn:
        return "".join(drawn)
    spots = [f"{_number(x)},{_number(y)}" for x, y in _in_page([state.position for state in states], top)]
    turns = [_number(-np.degrees(angle)) for _, angle in poses]
    path = clock.animate('animateTransform attributeName="transform" type="translate"', spots, smooth=True)
    turn = clock.animate('animateTransform attributeName="transform" type="rotate" additive="sum"', turns, smooth=True)
    return f'<g transform="translate({spots[0]}) rotate({turns[0]})">{path}{turn}{"".join(drawn)}</g>'


def _in_page(points: Sequence[Point] | np.ndarray, top: float) -> np.ndarray:
    """Points (point, 2) of the world in units."""
    return np.add(points, (BORDER, -top)) * (SCALE, -SCALE)


def _shape(shape: Shape, to_page: ToPage) -> str:
    match shape:
        case Polygon(points, fill, edge, width, hatched):
            corners, line = _points(points, to_page), _stroke(edge, width)
            return "".join(
                f'<polygon points="{corners}" fill="{paint}"{line}/>' for paint in _paints(fill, edge, hatched)
            )
        case Disc(centre, radius, fill, edge, hatched):
            x, y, r = map(_number, (*to_page([centre])[0], (radius - EDGE / 2) * SCALE))
            circle = f'<circle cx="{x}" cy="{y}" r="{r}"{_stroke(edge, EDGE)}'
            return "".join(f'{circle} fill="{paint}"/>' for paint in _paints(fill, edge, hatched))
        case Line(points, colour, width):
            return f'<polyline points="{_points(points, to_page)}" fill="none"{_stroke(colour, width)}/>'
        case Rectangle(low, high, fill, corner):
            (left, bottom), (right, upper) = to_page([low, high])
            sides = f'width="{_number(right - left)}" height="{_number(bottom - upper)}" rx="{_number(corner * SCALE)}"'
            return f'<rect x="{_number(left)}" y="{_number(upper)}" {sides} fill="{_colour(fill)}"/>'
        case Text():
            return _text(shape, to_page)


def _paints(fill: Colour, edge: Colour | None, hatched: bool) -> list[str]:
    """What a shape is filled with, one above the other."""
    return [_colour(fill), f"url(#{_name(edge)})"] if edge and hatched else [_colour(fill)]


def _text(text: Text, to_page: ToPage) -> str:
    """Words as wide as in the pictures, whatever letters the reader's machine has."""
    x, y = to_page([text.position])[0]
    baseline = y + text_drop(text.size) * SCALE
    anchor = ' text-anchor="end"' if text.ends else ""
    width = _number(text_width(text.words, text.size) * SCALE)
    return (
        f'<text x="{_number(x)}" y="{_number(baseline)}" font-size="{_number(text.size * SCALE)}"{anchor} '
        f'textLength="{width}" lengthAdjust="spacingAndGlyphs" fill="{_colour(text.colour)}">'
        f"{escape(text.words)}</text>"
    )


def _hatching(colour: Colour) -> str:
    """Diagonal lines, where x + y is a multiple of the pitch."""
    pitch, width = HATCH_PITCH * SCALE, _number(HATCH_WIDTH * SCALE)
    side, near, far, beyond = (_number(share * pitch, 4) for share in (1, 0.25, 0.75, 1.25))
    path = f"M0 {side}L{side} 0M-{near} {near}L{near} -{near}M{far} {beyond}L{beyond} {far}"
    tile = f'width="{side}" height="{side}" patternUnits="userSpaceOnUse"'
    stroke = f'stroke="{_colour(colour)}" stroke-width="{width}"'
    return f'<pattern id="{_name(colour)}" {tile}><path d="{path}" {stroke}/></pattern>'


def _stroke(colour: Colour | None, width: float) -> str:
    return f' stroke="{_colour(colour)}" stroke-width="{_number(width * SCALE)}"' if colour else ""


def _points(points: Sequence[Point], to_page: ToPage) -> str:
    return " ".join(f"{_number(x)},{_number(y)}" for x, y in to_page(points))


def _name(colour: Colour) -> str:
    return f"hatch-{_colour(colour)[1:]}"


@cache
def _colour(colour: Colour) -> str:
    red, green, blue = colour
    return f"#{red:02x}{green:02x}{blue:02x}"


def _number(value: float, digits: int = 2) -> str:
    """In as few letters as it takes."""
    words = f"{value:.{digits}f}".rstrip("0").rstrip(".")
    return "0" if words == "-0" else words
