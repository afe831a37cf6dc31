"""Matplotlib for the pages' plots."""

from typing import Any


def pyplot() -> Any:
    """Return `matplotlib.pyplot`, imported now and set to write the same SVG file for the same plot."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.hashsalt": "levelproof", "font.size": 9})
    import matplotlib.pyplot as plt

    return plt
