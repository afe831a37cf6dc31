"""Scenes as SVG: a picture or a film in one file.

A film is one drawing whose parts move: what a part does becomes SMIL animations, which browsers play in a loop.
Programs that do not play them show the first scene.
"""

from collections.abc import Sequence
from itertools import accumulate
from xml.sax.saxutils import escape

import numpy as np

from levelproof.levelgen.level import WORLD_SIDE
from levelproof.levelgen.pictures.shapes import Part, Scene, number, rectangle
from levelproof.levelgen.pictures.style import BORDER, FONTS, HATCH, HEADER, PAPER, PIXELS

WIDTH = WORLD_SIDE + 2 * BORDER  # m, of a picture
TOP = WORLD_SIDE + BORDER + HEADER  # m, of a picture's upper edge above the world's lower one


def svg_of(scenes: Sequence[Scene], seconds: Sequence[float], pixels: int = PIXELS) -> str:
    """The text of a file, `pixels` wide: a film that repeats, each scene shown for its seconds; of one, a picture.

    The scenes are of one level.
    """
    first, (*ends, length) = scenes[0], accumulate(seconds)
    clock = tuple(end / length for end in (0.0, *ends)), length
    height = TOP + first.footer
    size = f'width="{pixels}" height="{round(pixels * height / WIDTH)}" preserveAspectRatio="none"'
    view = f'viewBox="{-BORDER} {number(-TOP)} {number(WIDTH)} {number(height)}"'
    parts = [_part(states, clock) for states in zip(*(scene.parts for scene in scenes), strict=True)]
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" {size} {view} role="img" font-family="{FONTS}">',
            f"<title>{escape(first.title)}</title>",
            f"<defs>{HATCH}</defs>",
            '<g transform="scale(1,-1)" stroke-linejoin="round">',
            rectangle((-BORDER, -first.footer), (WIDTH - BORDER, TOP), PAPER),
            *filter(None, parts),
            "</g></svg>\n",
        ]
    )


Clock = tuple[tuple[float, ...], float]  # when the scenes of a film begin, as shares of its length; its length, s


def _animate(clock: Clock, tag: str, values: Sequence[str], smooth: bool) -> str:
    """An element that makes its parent follow one value a scene; of equal ones in a row, the ends alone."""
    (starts, length), last = clock, len(values) - 1
    keep = [
        i
        for i, value in enumerate(values)
        if i in (0, last) or values[i - 1] != value or (smooth and values[i + 1] != value)
    ]
    times, chosen = [f"{starts[i]:.5f}" for i in keep], [values[i] for i in keep]
    if smooth:  # the last scene stands still until the end
        times, chosen = [*times, "1"], [*chosen, chosen[-1]]
    mode = "" if smooth else ' calcMode="discrete"'
    return (
        f'<{tag} dur="{number(length)}s" repeatCount="indefinite"{mode} '
        f'keyTimes="{";".join(times)}" values="{";".join(chosen)}"/>'
    )


def _part(states: Sequence[Part], clock: Clock) -> str:
    """All that a part does: where it is in each scene, and which shapes it shows."""
    drawn = []
    for look in dict.fromkeys(state.shapes for state in states if state.shapes):
        shown = ["visible" if state.shapes == look else "hidden" for state in states]
        if "hidden" in shown:
            timing = _animate(clock, 'animate attributeName="visibility"', shown, smooth=False)
            look = f'<g visibility="{shown[0]}">{timing}{look}</g>'
        drawn.append(look)
    spots = [",".join(map(number, state.position)) for state in states]
    turns = [number(np.degrees(state.angle)) for state in states]
    if not drawn or {*spots, *turns} == {"0,0", "0"}:
        return "".join(drawn)
    motion = ""
    if len({*zip(spots, turns, strict=True)}) > 1:
        way = 'animateTransform attributeName="transform" type='
        motion = _animate(clock, f'{way}"translate"', spots, smooth=True)
        motion += _animate(clock, f'{way}"rotate" additive="sum"', turns, smooth=True)
    return f'<g transform="translate({spots[0]}) rotate({turns[0]})">{motion}{"".join(drawn)}</g>'
