"""What a bench found: numbers, how much they spread, and what they were measured on."""

import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import IO, Any

from rich.console import Console
from rich.table import Table

from benchmarks.race.contest import Score
from pipeline.runtime import own_cores
from pipeline.store.provenance import device, versions

DIGITS = 3  # decimals of what is printed as JSON


@dataclass(frozen=True)
class Result:
    """Rates are medians of env steps a second of the whole machine; the reference's is its best way to run."""

    bench: str
    size: str
    unit: str
    ours: float
    reference: float
    ratio: float  # ours / reference
    reference_way: str  # the faster of its ways to run
    ways: dict[str, float]  # median of each contestant
    spread: dict[str, list[float]]  # smallest and largest run of each
    runs: dict[str, list[float]]
    compile_seconds: dict[str, float]  # of each contestant, slowest process, nothing cached
    compile_ratio: float  # ours / the reference's lesser
    goal_share: dict[str, float | None]  # of the episodes that ended: a check that both play the same game
    finite: bool  # no NaN or infinity anywhere
    settings: dict[str, Any]
    machine: dict[str, Any]
    versions: dict[str, Any]
    date: str


def summary(
    bench: str, size: str, settings: Mapping[str, Any], scores: Sequence[Score], reference_versions: Mapping[str, str]
) -> Result:
    """The first of `scores` is ours, the others are ways to run the reference."""
    ours, *others = scores
    best = max(others, key=lambda score: score.rate)
    named = {score.entry.name: score for score in scores}
    theirs = min(score.compile_seconds for score in others)
    return Result(
        bench=bench,
        size=size,
        unit="env steps/s",
        ours=ours.rate,
        reference=best.rate,
        ratio=ours.rate / best.rate,
        reference_way=best.entry.name,
        ways={name: score.rate for name, score in named.items()},
        spread={name: [min(score.rates), max(score.rates)] for name, score in named.items()},
        runs={name: score.rates for name, score in named.items()},
        compile_seconds={name: score.compile_seconds for name, score in named.items()},
        compile_ratio=ours.compile_seconds / theirs,
        goal_share={name: score.goals / score.episodes if score.episodes else None for name, score in named.items()},
        finite=all(score.finite for score in scores),
        settings=dict(settings),
        machine={"device": device(), "cores": len(own_cores()), "system": platform.platform()},
        versions={"ours": versions(), "reference": dict(reference_versions)},
        date=datetime.now(UTC).isoformat(timespec="seconds"),
    )


def write_json(result: Result, file: IO[str]) -> None:
    json.dump(_rounded(asdict(result)), file, indent=2, allow_nan=False)
    file.write("\n")


def write_table(result: Result) -> None:
    """For people."""
    settings = ", ".join(f"{name} {value}" for name, value in result.settings.items())
    table = Table(title=f"{result.bench}, size {result.size}", caption=settings)
    for heading in ("", result.unit, "spread", "compile", "goals"):
        table.add_column(heading, justify="left" if not heading else "right")
    for name, rate in result.ways.items():
        low, high = result.spread[name]
        share = result.goal_share[name]
        table.add_row(
            name,
            f"{rate:,.0f}",
            f"{low:,.0f}-{high:,.0f}",
            f"{result.compile_seconds[name]:.1f} s",
            "-" if share is None else f"{share:.0%}",
        )
    console = Console(highlight=False, soft_wrap=True)
    console.print(table)
    machine = result.machine
    console.print(f"ratio {result.ratio:.1f}, compile ratio {result.compile_ratio:.2f}")
    console.print(f"{machine['device']}, {machine['cores']} cores, {machine['system']}, {result.date}", style="dim")
    if not result.finite:
        console.print("A state or a weight is not finite: do not trust these numbers.", style="bold red")


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _rounded(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return round(value, DIGITS) if isinstance(value, float) else value
