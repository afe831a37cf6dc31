"""Figures for a dataset's card: shares with intervals, histograms and learning curves.

Lengths are in hundreds of pixels; y points up. Knows nothing of splits.
"""

from collections.abc import Mapping, Sequence
from math import sqrt
from pathlib import Path
from typing import NamedTuple

import numpy as np

from levelproof.levelgen.level import Role
from levelproof.levelgen.pictures.raster import picture_of, write_png
from levelproof.levelgen.pictures.shapes import disc, line, rectangle, text, text_width
from levelproof.levelgen.pictures.style import FONTS, GRID, INK, MUTED, PAPER, ROLE_COLOUR

LETTER, SMALL = 0.16, 0.13  # letter heights
ROW = 0.34  # height of one share's row
LABEL, AXIS, VALUE = 1.6, 5.0, 1.9  # widths: names, the axis from 0 to 1, values
PANEL, HIGH, GAP = 2.6, 1.3, 0.35  # a panel's width and height; space between panels
ACROSS = 3  # panels side by side
SHARP = 2  # picture pixels per pixel on the page
DEVIATIONS = 1.96  # standard deviations of a 95% interval


class Share(NamedTuple):
    """`hits` out of `total`."""

    hits: int
    total: int

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95% interval (1927); from 0 to 1 if the total is 0."""
        if not self.total:
            return 0.0, 1.0
        z2, p = DEVIATIONS**2 / self.total, self.hits / self.total
        middle, half = p + z2 / 2, DEVIATIONS * sqrt((p * (1 - p) + z2 / 4) / self.total)
        return max(0.0, (middle - half) / (1 + z2)), min(1.0, (middle + half) / (1 + z2))

    @property
    def rounded(self) -> list[float]:
        """The interval, rounded for display and JSON."""
        return [round(end, 4) for end in self.interval]

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.hits / max(self.total, 1):.1%} ({low:.1%} to {high:.1%})"


def draw_shares(shares: Mapping[str, Share], title: str, path: Path) -> None:
    """Draw a row per share: a point, its 95% interval, and both as numbers."""
    top = ROW * len(shares)
    at = lambda share: LABEL + AXIS * share
    parts = [text((0.05, top + 0.55), title, INK, LETTER)]
    for tick in np.linspace(0, 1, 6):
        parts.append(line([(at(tick), 0), (at(tick), top)], GRID, 0.012))
        words = f"{tick:.0%}"
        parts.append(text((at(tick) - text_width(words, SMALL) / 2, top + 0.15), words, MUTED, SMALL))
    for number, (name, share) in enumerate(shares.items()):
        y = top - ROW * (number + 0.5)
        low, high = share.interval
        parts.append(text((LABEL - 0.15, y), name, INK, LETTER, ends=True))
        parts.append(line([(at(low), y), (at(high), y)], ROLE_COLOUR[Role.BLUE], 0.05))
        parts.append(disc((at(share.hits / share.total), y), 0.07, ROLE_COLOUR[Role.BLUE], ROLE_COLOUR[Role.BLUE]))
        parts.append(text((LABEL + AXIS + 0.15, y), str(share), INK, SMALL))
    write_figure(parts, (LABEL + AXIS + VALUE, top + 0.8), path)


def draw_panels(
    values: Mapping[str, np.ndarray],
    curves: Mapping[str, Sequence[np.ndarray]],
    bins: int,
    title: str,
    path: Path,
    most: int | None = None,
) -> None:
    """Draw a histogram per entry of `values`, then a panel of learning curves per entry of `curves`.

    Histograms span the range of their numbers or, if `most` is given, the integers from 1 to `most`.
    """
    panels = len(values) + len(curves)
    height = -(-panels // ACROSS) * (HIGH + 0.75)
    parts = [text((0.05, height + 0.25), title, INK, LETTER)]
    corners = [
        (0.15 + (number % ACROSS) * (PANEL + GAP), height - (number // ACROSS + 1) * (HIGH + 0.75) + 0.4)
        for number in range(panels)
    ]
    for (name, numbers), (left, low) in zip(values.items(), corners, strict=False):
        counts, edges = np.histogram(numbers, bins, (0.5, most + 0.5) if most else None)
        ends = (1, most) if most else (edges[0], edges[-1])
        parts += _histogram(counts / counts.sum(), (left, low), f"{name}: {len(numbers):,}")
        parts += _ends((left, low), *(f"{end:,.0f}" if end > 9 else f"{end:.2g}" for end in ends))
    for (name, lines), (left, low) in zip(curves.items(), corners[len(values) :], strict=True):
        last = max(2, *map(len, lines))
        parts += [line([(left, low + y), (left + PANEL, low + y)], GRID, 0.012) for y in (0, HIGH / 2, HIGH)]
        for rates in lines:
            updates = np.flatnonzero(~np.isnan(rates))
            points = np.stack([left + PANEL * updates / (last - 1), low + HIGH * rates[updates]], -1)
            parts.append(line(points, ROLE_COLOUR[Role.GREEN], 0.012))
        parts.append(text((left, low + HIGH + 0.18), f"{name}: {len(lines):,}", INK, SMALL))
        parts.append(text((left + PANEL, low + HIGH + 0.18), "100%", MUTED, SMALL, ends=True))
        parts += _ends((left, low), "update 1", str(last))
    write_figure(parts, (0.3 + min(panels, ACROSS) * (PANEL + GAP), height + 0.5), path)


def _ends(corner: tuple[float, float], first: str, last: str) -> list[str]:
    """Label both ends of a panel's axis."""
    left, low = corner
    return [
        text((left, low - 0.14), first, MUTED, SMALL),
        text((left + PANEL, low - 0.14), last, MUTED, SMALL, ends=True),
    ]


def _histogram(shares: np.ndarray, corner: tuple[float, float], title: str) -> list[str]:
    left, low = corner
    width, scale = PANEL / len(shares), HIGH / shares.max()
    bars = [
        rectangle((left + i * width, low), (left + (i + 0.85) * width, low + scale * share), ROLE_COLOUR[Role.GREEN])
        for i, share in enumerate(shares)
        if share
    ]
    peak = f"{shares.max():.0%}"
    return [
        line([(left, low), (left + PANEL, low)], MUTED, 0.012),
        *bars,
        text((left, low + HIGH + 0.18), title, INK, SMALL),
        text((left + PANEL, low + HIGH + 0.18), peak, MUTED, SMALL, ends=True),
    ]


def write_figure(parts: Sequence[str], size: tuple[float, float], path: Path) -> None:
    """Write elements as a picture of this size, in hundreds of pixels: SVG if the path ends so, else PNG."""
    width, height = size
    drawing = (
        f'<svg xmlns="http://www.w3.org/2000/svg" font-family="{FONTS}" width="{100 * SHARP * width:.0f}" '
        f'height="{100 * SHARP * height:.0f}" viewBox="0 {-height} {width} {height}"><g transform="scale(1,-1)">'
        f"{rectangle((0, 0), size, PAPER)}{''.join(parts)}</g></svg>"
    )
    if path.suffix.lower() == ".svg":
        path.write_text(drawing, encoding="utf-8")
    else:
        write_png(picture_of(drawing), path)
