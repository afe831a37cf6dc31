"""A benchmark's report, shown as text, as JSON, and as its page in docs/results."""

import json
import math
import platform
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from levelproof.pipeline.runtime import own_cores
from levelproof.pipeline.store.provenance import device, versions

RESULTS = Path(__file__).parent.parent / "docs" / "results"
DIGITS = 5  # significant digits of a number in JSON


@dataclass(frozen=True)
class Table:
    """A table of formatted cells."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""

    def markdown(self) -> str:
        lines = [self.head, ["---"] * len(self.head), *self.rows]
        text = "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
        return f"{self.title}:\n\n{text}" if self.title else text


@dataclass(frozen=True)
class Report:
    """Results of a benchmark."""

    title: str  # title of the page
    results: Sequence[Mapping[str, Any]]  # JSON documents; those of races have `ours`, `reference`, `ratio`
    tables: Sequence[Table]
    notes: Sequence[str] = ()  # sentences below the tables
    plots: Mapping[str, Callable[[Path], None]] = field(
        default_factory=dict
    )  # by file name: function that draws the plot
    reference: Mapping[str, str] = field(default_factory=dict)  # versions of the reference, if it took part
    fault: str = ""  # makes the command fail
    page: str = ""  # name of the page, if not the benchmark's
    made: str = ""  # when and where it was measured, if not now and here


@dataclass(frozen=True)
class Run:
    """Command, time, machine and versions of a benchmark run."""

    benchmark: str
    command: str
    date: str
    machine: Mapping[str, Any]
    versions: Mapping[str, Mapping[str, Any]]

    @staticmethod
    def now(benchmark: str, arguments: Sequence[str], report: Report) -> "Run":
        return Run(
            benchmark=benchmark,
            command=f"python -m benchmarks {shlex.join(arguments)}",
            date=datetime.now(UTC).isoformat(timespec="seconds"),
            machine={"device": device(), "cores": len(own_cores()), "system": platform.platform()},
            versions={"ours": versions(), **({"reference": report.reference} if report.reference else {})},
        )

    @property
    def made(self) -> str:
        """Sentence on when and where."""
        machine = "{device}, {cores} {unit}, {system}".format_map(
            {**self.machine, "unit": "core" if self.machine["cores"] == 1 else "cores"}
        )
        sides = [
            f"{side}: {', '.join(f'{name} {x}' for name, x in stack.items())}" for side, stack in self.versions.items()
        ]
        return f"{self.date}, on {machine}; {'; '.join(sides)}"


def as_text(report: Report, run: Run) -> str:
    """Format a report for a terminal."""
    tables = [table.markdown() for table in report.tables]
    return "\n\n".join((*tables, *report.notes, report.made or f"{run.made}."))


def as_page(report: Report, run: Run) -> str:
    """Format a report as a page of docs/results, which only its benchmark writes."""
    tables = [table.markdown() for table in report.tables]
    made = f"Written by `{run.command}`. Measured: {report.made or run.made}."
    return "\n\n".join((f"# {report.title}", made, *tables, *report.notes)) + "\n"


def as_json(report: Report, run: Run) -> str:
    """Format a report as one JSON document per result."""
    about = {"date": run.date, "machine": run.machine, "versions": run.versions}
    documents = [{"bench": run.benchmark, **result, **about} for result in report.results]
    return "\n".join(json.dumps(rounded(document), indent=2, allow_nan=False) for document in documents)


def rounded(value: Any) -> Any:
    """Round floats for JSON: NaN becomes null, infinity a string."""
    if isinstance(value, Mapping):
        return {name: rounded(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    if not isinstance(value, float):
        return value
    if not math.isfinite(value):
        return None if math.isnan(value) else str(value)
    return float(f"{value:.{DIGITS}g}")
