"""The unsolved share by budget: a plot and a table.

A level counts as solved from the env steps at which it left its slot as solved. A run with that budget solves a few
levels more: its experts are evaluated when the budget ends, however rarely they have succeeded.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.plotting import save
from benchmarks.report import Table
from benchmarks.solved.results import Results, count, share
from benchmarks.solved.tables import order
from levelproof.pipeline.look.figures import Share

MIN_STEPS = 4_000  # env steps where the axis begins
POINTS = 120  # of a curve; more would be invisible
MARKS = (64_000, 256_000, 1_000_000, 4_000_000)
TICKS = (4_000, 16_000, *MARKS)
COLOURS = ("#2a85c7", "#d55e00", "#009e73", "#b3679b", "#b8860b")  # visible on white and on black
GREY = "#7d8590"  # for axes and text; visible on white and on black


def has_curve(results: Results) -> bool:
    """Whether results have a curve: levels may leave early, and the budget reaches the axis."""
    return results.header.stops_early and bool(results.trained) and results.header.budget > MIN_STEPS


def ordered(results: Sequence[Results]) -> list[Results]:
    return sorted(results, key=order)


def unsolved(results: Results, within: float) -> int:
    """Count levels with an expert that have not left their slots as solved within `within` env steps."""
    return len(results.trained) - len(results.solved(within))


def curve(results: Results) -> tuple[list[float], list[int]]:
    """Return env steps, from the start of the axis to the budget, and the number of unsolved levels at each."""
    budget = results.header.budget
    even = np.geomspace(MIN_STEPS, budget, POINTS)[1:-1].tolist()
    steps = [float(MIN_STEPS), *sorted({*even, *(float(mark) for mark in MARKS if mark < budget)}), float(budget)]
    return steps, [unsolved(results, x) for x in steps]


def names(results: Sequence[Results]) -> list[str]:
    """Return the shortest labels that distinguish the results."""
    single = len({each.header.variant for each in results}) == 1
    text = lambda each: f"size {each.header.size}" + ("" if single else f", {each.header.variant}")
    short = [text(each) for each in results]
    again = len(set(short)) < len(short)
    return [
        f"{name}, {count(each.header.budget)}" if again else name for name, each in zip(short, results, strict=True)
    ]


def table(results: Sequence[Results]) -> Table:
    """Tabulate the unsolved share at the marks and at the budget."""
    marks = sorted({mark for each in results for mark in (*MARKS, each.header.budget) if mark <= each.header.budget})
    rows = []
    for name, each in zip(names(results), results, strict=True):
        levels = len(each.trained)
        cells = [share(unsolved(each, mark), levels) if mark <= each.header.budget else "-" for mark in marks]
        rows.append([name, str(levels), *cells])
    head = ("", "levels with an expert", *(f"unsolved at {count(mark)} (95% interval)" for mark in marks))
    return Table(head, rows, "**The unsolved share by budget**")


def draw(results: Sequence[Results], out: Path) -> None:
    """Write the plot as SVG without a background."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.hashsalt": "levelproof", "svg.fonttype": "none", "font.size": 9})
    matplotlib.rc("text", color=GREY)
    matplotlib.rc("axes", labelcolor=GREY, edgecolor=GREY)
    matplotlib.rc("xtick", color=GREY)
    matplotlib.rc("ytick", color=GREY)
    import matplotlib.pyplot as plt
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator, PercentFormatter

    figure, axes = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
    for i, (name, each) in enumerate(zip(names(results), results, strict=True)):
        draw_curve(axes, each, name, COLOURS[i % len(COLOURS)])
    end = max(each.header.budget for each in results)
    axes.set(xscale="log", xlim=(MIN_STEPS, end * 1.05), ylim=(0, None))
    axes.set(xlabel="training env steps of a level", ylabel="levels not yet solved")
    axes.xaxis.set_major_locator(FixedLocator([tick for tick in TICKS if tick <= end]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: count(x)))
    axes.yaxis.set_major_formatter(PercentFormatter(1, 0))
    axes.grid(alpha=0.3, linewidth=0.5, color=GREY)
    axes.legend(frameon=False)
    out.parent.mkdir(parents=True, exist_ok=True)
    save(figure, out, transparent=True)


def draw_curve(axes: Any, results: Results, name: str, colour: str) -> None:
    """Draw the unsolved share of a variant, with its interval and marks."""
    levels, (steps, remaining) = len(results.trained), curve(results)
    low, high = zip(*(Share(k, levels).interval for k in remaining), strict=True)
    axes.fill_between(steps, low, high, color=colour, alpha=0.2, linewidth=0)
    axes.plot(steps, [k / levels for k in remaining], color=colour, linewidth=1.6, label=name)
    marks = [mark for mark in MARKS if mark <= results.header.budget]
    axes.plot(marks, [unsolved(results, x) / levels for x in marks], "o", color=colour, markersize=4)
