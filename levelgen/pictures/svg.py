"""Scenes as SVG: a picture or a film in one file.

A film is one drawing whose parts move by SMIL animations, which browsers play in a loop. Programs that do not play
them show the first scene.
"""

from collections.abc import Sequence
from itertools import accumulate
from xml.sax.saxutils import escape

import numpy as np

from levelproof.levelgen.level import WORLD_SIDE
from levelproof.levelgen.pictures.shapes import Part, Scene, digits, rectangle
from levelproof.levelgen.pictures.style import BORDER, FONTS, HATCH, HEADER, PAPER, PIXELS

WIDTH = WORLD_SIDE + 2 * BORDER  # m, of a picture
TOP = WORLD_SIDE + BORDER + HEADER  # m, height of a picture's upper edge above the world's lower edge


def svg_of(scenes: Sequence[Scene], seconds: Sequence[float], pixels: int = PIXELS) -> str:
    """Return an SVG document, `pixels` wide: a looping film that shows each scene for its seconds.

    A single scene gives a picture. All scenes must be of one level.
    """
    first, (*ends, length) = scenes[0], accumulate(seconds)
    clock = tuple(end / length for end in (0.0, *ends)), length
    height = TOP + first.footer
    size = f'width="{pixels}" height="{round(pixels * height / WIDTH)}" preserveAspectRatio="none"'
    view = f'viewBox="{-BORDER} {digits(-TOP)} {digits(WIDTH)} {digits(height)}"'
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


Clock = tuple[tuple[float, ...], float]  # start of each scene as a fraction of the film; length of the film, s


def _animate(clock: Clock, tag: str, values: Sequence[str], smooth: bool) -> str:
    """Animate the parent element by one value per scene, without the redundant values in a run of equal ones."""
    (starts, length), last = clock, len(values) - 1
    keep = [
        i
        for i, value in enumerate(values)
        if i in (0, last) or values[i - 1] != value or (smooth and values[i + 1] != value)
    ]
    times, chosen = [f"{starts[i]:.5f}" for i in keep], [values[i] for i in keep]
    if smooth:  # hold the last scene until the end
        times, chosen = [*times, "1"], [*chosen, chosen[-1]]
    mode = "" if smooth else ' calcMode="discrete"'
    return (
        f'<{tag} dur="{digits(length)}s" repeatCount="indefinite"{mode} '
        f'keyTimes="{";".join(times)}" values="{";".join(chosen)}"/>'
    )


def _part(states: Sequence[Part], clock: Clock) -> str:
    """Draw a part with its motion over the scenes, and with the visibility of each of its shapes."""
    drawn = []
    for shapes in dict.fromkeys(state.shapes for state in states if state.shapes):
        visibility = ["visible" if state.shapes == shapes else "hidden" for state in states]
        if "hidden" in visibility:
            timing = _animate(clock, 'animate attributeName="visibility"', visibility, smooth=False)
            shapes = f'<g visibility="{visibility[0]}">{timing}{shapes}</g>'
        drawn.append(shapes)
    positions = [",".join(map(digits, state.position)) for state in states]
    turns = [digits(np.degrees(state.angle)) for state in states]
    if not drawn or {*positions, *turns} == {"0,0", "0"}:
        return "".join(drawn)
    motion = ""
    if len({*zip(positions, turns, strict=True)}) > 1:
        tag = 'animateTransform attributeName="transform" type='
        motion = _animate(clock, f'{tag}"translate"', positions, smooth=True)
        motion += _animate(clock, f'{tag}"rotate" additive="sum"', turns, smooth=True)
    return f'<g transform="translate({positions[0]}) rotate({turns[0]})">{motion}{"".join(drawn)}</g>'
