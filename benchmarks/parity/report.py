"""What the campaign found, as tables and as JSON."""

import json
import platform
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import IO, Any

from rich.console import Console
from rich.table import Table

from benchmarks.parity.campaign import SizeReport
from benchmarks.parity.episodes import FIRST_OFF, NOT_EXPLAINED
from benchmarks.parity.onestep import DEFECT_OFF, LIMITS
from pipeline.errors import Failure
from pipeline.store.provenance import device, versions

DIGITS = 4  # of a number in JSON
WIDE = 200  # columns


@dataclass(frozen=True)
class Report:
    """The campaign of some sizes."""

    sizes: list[SizeReport]
    settings: dict[str, Any]
    machine: dict[str, Any]
    versions: dict[str, Any]
    date: str
    bench: str = "parity"

    @staticmethod
    def of(sizes: list[SizeReport], settings: dict[str, Any], reference_versions: dict[str, str]) -> "Report":
        return Report(
            sizes=sizes,
            settings=settings,
            machine={"device": device(), "system": platform.platform()},
            versions={"ours": versions(), "reference": reference_versions},
            date=datetime.now(UTC).isoformat(timespec="seconds"),
        )

    def unexplained(self) -> list[str]:
        """Where states and episodes come from that nothing explains."""
        found = []
        for one in self.sizes:
            found += [f"size {one.size}, {state.origin}" for state in one.one_step.off if not state.explained]
            pairs = one.episodes.parted if one.episodes else []
            found += [f"size {one.size}, episode of {pair.origin}" for pair in pairs if pair.reason == NOT_EXPLAINED]
        return found

    def check(self) -> None:
        """Complain of what nothing explains.

        Raises:
            Failure: there is such a state or episode.
        """
        if found := self.unexplained():
            more = f" and {len(found) - 3} more" if len(found) > 3 else ""
            raise Failure(
                f"Rounding does not explain {len(found)} differences from the reference "
                f"({'; '.join(found[:3])}{more}): --json lists them; look for a defect of the engine."
            )

    def write_json(self, file: IO[str]) -> None:
        json.dump(_rounded(asdict(self)), file, indent=1)
        file.write("\n")

    def write_tables(self) -> None:
        """For people."""
        console = Console(highlight=False, soft_wrap=True)
        if not console.is_terminal:  # a file has room for whole words
            console.width = WIDE
        for title, head, rows in tables(self):
            table = Table(title=title, title_justify="left")
            for k, name in enumerate(head):
                table.add_column(name, justify="right" if k > 1 else "left")
            for row in rows:
                table.add_row(*row)
            console.print(table)
        for text in self.unexplained():
            console.print(f"NOT EXPLAINED: {text}", style="bold red")
        console.print(f"{self.machine['device']}, {self.machine['system']}, {self.date}", style="dim")


def tables(report: Report) -> list[tuple[str, Sequence[str], list[Sequence[str]]]]:
    """(title, headings, rows) of each table."""
    within = [f"within {limit:.0e}" for limit in LIMITS]
    found = [
        ("One physics step, by field", FIELD_HEAD, [row for one in report.sizes for row in _field_rows(one)]),
        (
            "One physics step, largest difference of any place or speed, by scene",
            ("size", "scene", "states", *within, "median", "largest", "other contacts", "looked into"),
            [row for one in report.sizes for row in _scene_rows(one)],
        ),
        (
            "What was looked into (off by 1e-3, impulses included), by cause",
            ("size", "cause", "states", "explained", "largest in m, rad, m/s, rad/s"),
            [row for one in report.sizes for row in _cause_rows(one)],
        ),
        (
            "What the fix of the padding defect changes in one step of ours",
            ("size", "states", *(f"by {limit:.0e}" for limit in DEFECT_OFF), "largest"),
            [_defect_row(one) for one in report.sizes],
        ),
    ]
    if played := [one for one in report.sizes if one.episodes]:
        found += [
            ("Whole episodes, share with the same outcome", EPISODE_HEAD, [_episode_row(one) for one in played]),
            (
                "Why episodes part",
                ("size", "reason", "episodes", *(f"off by {limit:.0e} at" for limit in FIRST_OFF), "at a contact"),
                [row for one in played for row in _reason_rows(one)],
            ),
        ]
    return found


FIELD_HEAD = ("size", "field", "unit", "median", "99%", "99.9%", "largest", "states above 1e-3")
EPISODE_HEAD = (
    "size",
    "episodes",
    "end by touch",
    "ours and reference",
    "of those by touch",
    "target",
    "reference and itself, 1 ulp",
    "ours and itself, 1 ulp",
)


def _field_rows(one: SizeReport) -> list[Sequence[str]]:
    return [
        (one.size, x.field, x.unit, *(f"{y:.1e}" for y in (x.median, x.p99, x.p999, x.largest)), str(x.above))
        for x in one.one_step.fields
    ]


def _scene_rows(one: SizeReport) -> list[Sequence[str]]:
    return [
        (
            one.size,
            x.scene,
            str(x.states),
            *(f"{share:.2%}" for share in x.within),
            f"{x.median:.1e}",
            f"{x.largest:.1e}",
            str(x.other_contacts),
            str(x.off),
        )
        for x in one.one_step.scenes
    ]


def _cause_rows(one: SizeReport) -> list[Sequence[str]]:
    rows = []
    for cause, count in one.one_step.causes.items():
        of = [state for state in one.one_step.off if state.cause == cause]
        explained = sum(state.explained for state in of)
        largest = max((state.motion for state in of), default=0.0)
        rows.append((one.size, cause, str(count), str(explained), f"{largest:.1e}"))
    return rows


def _defect_row(one: SizeReport) -> Sequence[str]:
    x = one.one_step.defect
    return one.size, str(x.states), *map(str, x.differ), f"{x.largest:.1g}"


def _episode_row(one: SizeReport) -> Sequence[str]:
    x = one.episodes
    assert x is not None
    share = lambda value: "-" if value is None else f"{value:.1%}"
    shares = (x.same, x.same_touched, x.target, x.reference_itself, x.ours_itself)
    return one.size, str(x.pairs), str(x.touched), *map(share, shares)


def _reason_rows(one: SizeReport) -> list[Sequence[str]]:
    assert one.episodes is not None
    rows = []
    for reason, count in one.episodes.reasons.items():
        of = [pair for pair in one.episodes.parted if pair.reason == reason]
        medians = (_median([pair.first_off[k] for pair in of]) for k in range(len(FIRST_OFF)))
        rows.append((one.size, reason, str(count), *medians, str(sum(pair.at_contact for pair in of))))
    return rows


def _median(steps: Sequence[int | None]) -> str:
    known = [step for step in steps if step is not None]
    return f"env step {statistics.median(known):.0f}" if known else "-"


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _rounded(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
