"""A run's learning curves as a picture."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from levelproof.levelgen.level import Role
from levelproof.levelgen.pictures.shapes import disc, line, text, text_width
from levelproof.levelgen.pictures.style import BINDING_COLOUR, GRID, INK, MUTED, ROLE_COLOUR, Colour
from levelproof.pipeline.look.figures import LETTER, SMALL, write_figure

GREEN, BLUE, YELLOW = ROLE_COLOUR[Role.GREEN], ROLE_COLOUR[Role.BLUE], BINDING_COLOUR[0]


class Panel(NamedTuple):
    """A quantity over a run's progress."""

    title: str
    lines: Mapping[Colour, str]  # metrics by colour
    top: float | None = None  # end of the axis, which starts at 0; None: the largest value


class Curves(NamedTuple):
    """Axis, panels and legend of one kind of run's curves."""

    step: str  # the metric that the others are plotted over
    unit: str  # unit of the step
    panels: Sequence[Panel]
    names: Mapping[Colour, str]  # of the colours


WIDE, HIGH, GAP, EDGE = 4.0, 2.2, 0.9, 0.75  # width and height of a panel, gap between panels, margin
TICKS = 5


def draw_curves(metrics: Sequence[Mapping[str, float]], curves: Curves, path: Path) -> None:
    """Draw the lines of a metrics file as a PNG, or as SVG if the path ends so."""
    parts = []
    for number, panel in enumerate(curves.panels):
        parts += _panel(metrics, curves, panel, (EDGE + number * (WIDE + GAP), EDGE))
    left = EDGE
    for colour, name in curves.names.items():
        parts.append(disc((left, EDGE + HIGH + 0.75), 0.07, colour, colour))
        parts.append(text((left + 0.15, EDGE + HIGH + 0.75), name, INK, LETTER))
        left += 0.5 + text_width(name, LETTER)
    count = len(curves.panels)
    write_figure(parts, (2 * EDGE + count * WIDE + (count - 1) * GAP, EDGE + HIGH + 1.1), path)


def _panel(
    metrics: Sequence[Mapping[str, float]], curves: Curves, panel: Panel, corner: tuple[float, float]
) -> list[str]:
    (left, low), steps = corner, np.array([each[curves.step] for each in metrics])
    values = {colour: np.array([each.get(name, np.nan) for each in metrics]) for colour, name in panel.lines.items()}
    finite = [y[np.isfinite(y)] for y in values.values()]
    top = panel.top or max([1e-3, *np.concatenate(finite)])
    last = max([1, *steps])
    parts = [text((left, low + HIGH + 0.3), panel.title, INK, LETTER)]
    for share in np.linspace(0, 1, TICKS):
        y, words = low + HIGH * share, f"{top * share:.2g}"
        parts.append(line([(left, y), (left + WIDE, y)], GRID, 0.012))
        parts.append(text((left - 0.1, y), words, MUTED, SMALL, ends=True))
    parts.append(text((left, low - 0.25), "0", MUTED, SMALL))
    parts.append(text((left + WIDE, low - 0.25), f"{last:,.0f} {curves.unit}", MUTED, SMALL, ends=True))
    for (colour, y), kept in zip(values.items(), map(np.isfinite, values.values()), strict=True):
        points = np.stack([left + WIDE * steps / last, low + HIGH * np.clip(y / top, 0, 1)], -1)[kept]
        if len(points):
            parts += [line(points, colour, 0.03), disc(tuple(points[-1].tolist()), 0.06, colour, colour)]
    return parts
