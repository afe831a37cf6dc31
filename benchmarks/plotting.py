"""Matplotlib for the pages' plots."""

from pathlib import Path
from typing import Any


def pyplot() -> Any:
    """Return `matplotlib.pyplot`, imported now and set to write the same SVG file for the same plot."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.hashsalt": "levelproof", "font.size": 9})
    import matplotlib.pyplot as plt

    return plt


def save(figure: Any, path: Path, **options: Any) -> None:
    """Write a figure without the top and right edges of its axes, and without a date; close it.

    `options` are those of `Figure.savefig`.
    """
    import matplotlib.pyplot as plt

    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, metadata={"Date": None}, **options)
    plt.close(figure)
