"""Figures of a dataset's card: shares with their intervals, and histograms, drawn as pictures of levels are.

Lengths are hundreds of pixels, y is upwards. Knows nothing of splits.
"""

from collections.abc import Mapping, Sequence
from math import sqrt
from pathlib import Path
from typing import NamedTuple

import numpy as np

from levelgen.level import Role
from levelgen.pictures.raster import picture_of, write_png
from levelgen.pictures.shapes import disc, line, rectangle, text, text_width
from levelgen.pictures.style import FONTS, GRID, INK, MUTED, PAPER, ROLE_COLOUR

LETTER, SMALL = 0.16, 0.13  # of words
ROW = 0.34  # height of a share
LABEL, AXIS, VALUE = 1.6, 5.0, 1.9  # widths: names, the axis from 0 to 1, values
PANEL, HIGH, GAP = 2.6, 1.3, 0.35  # a histogram's width and height, and what is between them
ACROSS = 3  # histograms side by side
SHARP = 2  # pixels of a picture for each that it has on a page
DEVIATIONS = 1.96  # of a 95% interval


class Share(NamedTuple):
    """So many of so many."""

    hits: int
    of: int

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's, 95%."""
        z2, p = DEVIATIONS**2 / self.of, self.hits / self.of
        middle, half = p + z2 / 2, DEVIATIONS * sqrt((p * (1 - p) + z2 / 4) / self.of)
        return max(0.0, (middle - half) / (1 + z2)), min(1.0, (middle + half) / (1 + z2))

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.hits / self.of:.1%} ({low:.1%} to {high:.1%})"


def draw_shares(shares: Mapping[str, Share], title: str, path: Path) -> None:
    """A row for each share: a point, its 95% interval, and both in numbers."""
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
        parts.append(disc((at(share.hits / share.of), y), 0.07, ROLE_COLOUR[Role.BLUE], ROLE_COLOUR[Role.BLUE]))
        parts.append(text((LABEL + AXIS + 0.15, y), str(share), INK, SMALL))
    _write(parts, (LABEL + AXIS + VALUE, top + 0.8), path)


def draw_histograms(values: Mapping[str, np.ndarray], most: int, bins: int, title: str, path: Path) -> None:
    """A histogram for each name: whole numbers from 1 to `most`, in so many bins, as shares of all."""
    lines = -(-len(values) // ACROSS)
    height = lines * (HIGH + 0.75)
    parts = [text((0.05, height + 0.25), title, INK, LETTER)]
    for number, (name, numbers) in enumerate(values.items()):
        left = 0.15 + (number % ACROSS) * (PANEL + GAP)
        low = height - (number // ACROSS + 1) * (HIGH + 0.75) + 0.4
        counts, _ = np.histogram(numbers, bins, (0.5, most + 0.5))
        parts += _histogram(counts / counts.sum(), (left, low), f"{name}: {len(numbers):,}")
        for words, x in (("1", left), (str(most), left + PANEL - text_width(str(most), SMALL))):
            parts.append(text((x, low - 0.14), words, MUTED, SMALL))
    _write(parts, (0.3 + min(len(values), ACROSS) * (PANEL + GAP), height + 0.5), path)


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


def _write(parts: Sequence[str], size: tuple[float, float], path: Path) -> None:
    width, height = size
    drawing = (
        f'<svg xmlns="http://www.w3.org/2000/svg" font-family="{FONTS}" width="{100 * SHARP * width:.0f}" '
        f'height="{100 * SHARP * height:.0f}" viewBox="0 {-height} {width} {height}"><g transform="scale(1,-1)">'
        f"{rectangle((0, 0), size, PAPER)}{''.join(parts)}</g></svg>"
    )
    write_png(picture_of(drawing), path)
