"""Results of every level: a row per size, budget, variant and level, in one parquet file."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from benchmarks.oracle import alone
from levelproof.experts.config import Rule
from levelproof.experts.labels import TRAINED, Label
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.look.figures import Share

FILE = Path(__file__).parents[1] / "results" / "solved.parquet"
SIZES = ("s", "m", "l")  # in this order; custom sizes follow
WORD = pa.dictionary(pa.int32(), pa.string())
SCHEMA = pa.schema(
    [
        ("size", WORD),
        ("budget", pa.int64()),
        ("variant", WORD),
        ("level_id", pa.int64()),
        ("label", WORD),
        ("env_steps", pa.int64()),  # of training
        ("evaluation_steps", pa.int64()),  # env steps, as the next one; null: not counted
        ("search_steps", pa.int64()),
        ("witness", WORD),  # source of the witness; null: no witness, or not recorded
        # of sampled first episodes after training (older rows: in the last evaluation); null: none ended
        ("success_rate", pa.float64()),
        ("most_probable_succeeds", pa.bool_()),  # in the last evaluation; null: not recorded
        ("steps_to_goal", pa.int32()),  # env steps of the witness's first episode; null: no witness
        ("core_seconds", pa.float64()),  # excludes compiling, and slots that are empty at the end
        ("settings", WORD),  # of the procedure, as JSON
        ("versions", WORD),  # as JSON
        ("device", WORD),
        ("date", WORD),
    ]
)
OF_LEVEL = (
    "label", "env_steps", "evaluation_steps", "search_steps", "witness", "success_rate",
    "most_probable_succeeds", "steps_to_goal", "core_seconds",
)  # fmt: skip
OF_RUN = ("versions", "device", "date")


@dataclass(frozen=True)
class Header:
    """What levels of a variant, size and budget share, and their results depend on."""

    variant: str
    size: str
    budget: int
    config: dict[str, Any]  # settings of the procedure

    @property
    def name(self) -> str:
        """Name of the group, such as `s-64k-default`."""
        return f"{self.size}-{count(self.budget)}-{self.variant}"

    @property
    def stops_early(self) -> bool:
        """Whether `env_steps` says when a level was solved."""
        return self.config["stop"]["rule"] != Rule.BUDGET


@dataclass(frozen=True)
class Results:
    """The levels of one header."""

    header: Header
    rows: dict[int, dict[str, Any]]  # OF_LEVEL and OF_RUN, by level id

    @property
    def trained(self) -> dict[int, dict[str, Any]]:
        """Rows of levels that got an expert."""
        return {level_id: row for level_id, row in self.rows.items() if row["label"] in TRAINED}

    def solved(self, within: float = math.inf) -> set[int]:
        """Return the levels that left their slots as solved within `within` env steps."""
        rows = self.trained.items()
        return {level_id for level_id, row in rows if row["label"] == Label.SOLVED and row["env_steps"] <= within}


def read(file: Path = FILE) -> list[Results]:
    """Read all results; none if the file does not exist.

    Raises:
        UserError: the file has another format.
    """
    if not file.exists():
        return []
    try:
        lines = pq.read_table(file, schema=SCHEMA).to_pylist()
    except (OSError, pa.ArrowException) as error:
        raise UserError(f"{file} is not a file that `python -m benchmarks solved` has written ({error}).") from None
    groups: dict[tuple[str, int, str], Results] = {}
    for line in lines:
        key = line["size"], line["budget"], line["variant"]
        if key not in groups:
            groups[key] = Results(Header(key[2], key[0], key[1], json.loads(line["settings"])), {})
        groups[key].rows[line["level_id"]] = {name: line[name] for name in (*OF_LEVEL, *OF_RUN)}
    return list(groups.values())


def merge(new: Results, file: Path = FILE) -> None:
    """Merge results into the file, level by level; results from other settings replace the whole group."""
    with alone(file.with_suffix(".lock")):
        merged = {results.header.name: results for results in read(file)}
        old = merged.get(new.header.name)
        unreplaced = old.rows if old and old.header == new.header else {}
        merged[new.header.name] = Results(new.header, unreplaced | new.rows)
        write(merged.values(), file)


def write(results: Iterable[Results], file: Path) -> None:
    """Write all results in a fixed order, so that equal results make equal files."""
    lines = [
        {"size": h.size, "budget": h.budget, "variant": h.variant, "level_id": level_id}
        | {"settings": json.dumps(h.config), **row}
        for h, rows in ((each.header, each.rows) for each in results)
        for level_id, row in rows.items()
    ]
    lines.sort(key=lambda line: (by_size(line["size"]), line["budget"], line["variant"], line["level_id"]))
    unfinished = file.with_suffix(".unfinished")
    file.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist(lines, SCHEMA), unfinished, compression="zstd", compression_level=19)
    unfinished.replace(file)


def by_size(size: str) -> tuple[int, str]:
    return SIZES.index(size) if size in SIZES else len(SIZES), size


def made(results: Sequence[Results]) -> str:
    """Say in a sentence when, where and with which versions results were made."""
    runs: dict[str, Mapping[str, None]] = {
        name: dict.fromkeys(row[name] for each in results for row in each.rows.values()) for name in OF_RUN
    }
    stacks: dict[str, dict[str, None]] = {}
    for stack in map(json.loads, runs["versions"]):
        reference = {f"reference: {name}": x for name, x in stack.pop("reference", {}).items()}
        for name, x in (stack | reference).items():
            stacks.setdefault(name, {})[str(x)] = None
    dates = sorted(runs["date"])
    when = dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}" if dates else ""
    stack = ", ".join(f"{name} {' and '.join(x)}" for name, x in stacks.items())
    return f"{when}, on {', '.join(runs['device'])}; {stack}"


def mean(values: Sequence[float | None]) -> float | None:
    """Return the mean of the values that are not None."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def share(successes: int, trials: int) -> str:
    """Format a share with its 95% interval, such as `41.2% (37.0 to 45.5)`."""
    if not trials:
        return "-"
    low, high = Share(successes, trials).interval
    return f"{successes / trials:.1%} ({100 * low:.1f} to {100 * high:.1f})"


def count(number: float) -> str:
    """Format a count, such as `64k`, `1M` or `1.5M`."""
    for scale, letter in ((1_000_000, "M"), (1_000, "k")):
        if number >= scale:
            return f"{number / scale:.4g}{letter}"
    return f"{number:.0f}"
