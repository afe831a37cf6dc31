"""Files of results, and statistics of them."""

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from experts.config import Rule
from experts.labels import Label
from pipeline.errors import UserError

Z = 1.959964  # of a normal distribution: 95% lie within
EXPERT = frozenset({Label.SOLVED, Label.UNSOLVED})  # labels of levels that get an expert


@dataclass(frozen=True)
class Header:
    """What a file's levels have in common and what their results depend on."""

    variant: str
    size: str
    budget: int
    config: dict[str, Any]  # settings of the expert and of stopping

    @property
    def text(self) -> str:
        return f"{self.variant}, size {self.size}, {count(self.budget)}"

    @property
    def stops_early(self) -> bool:
        """Whether `env_steps` tells when a level was solved."""
        return self.config["stop"]["rule"] != Rule.BUDGET


@dataclass(frozen=True)
class Results:
    """A file."""

    header: Header
    rows: dict[int, dict[str, Any]]  # by level id

    @property
    def trained(self) -> dict[int, dict[str, Any]]:
        """Rows of levels that got an expert."""
        return {level_id: row for level_id, row in self.rows.items() if row["label"] in EXPERT}

    def solved(self, within: float = math.inf) -> set[int]:
        """Levels that left their slots as solved after at most so many env steps."""
        rows = self.trained.items()
        return {level_id for level_id, row in rows if row["label"] == Label.SOLVED and row["env_steps"] <= within}


def header_of(header: Header, versions: dict[str, Any], device: str) -> dict[str, Any]:
    """A file's first line."""
    return asdict(header) | {"versions": versions, "device": device}


def read(file: Path) -> Results:
    """A file's results.

    Raises:
        UserError: it is not there, or none of ours.
    """
    try:
        head, *rows = [json.loads(line) for line in file.read_text().splitlines()]
        header = Header(**{name: head[name] for name in ("variant", "size", "budget", "config")})
        return Results(header, {row["level_id"]: row for row in rows})
    except OSError as error:
        raise UserError(f"{file} cannot be read: {error.strerror}.") from None
    except (ValueError, KeyError, TypeError):
        raise UserError(f"{file} is not a file that `python -m benchmarks.solved run` has written.") from None


def read_all(files: Iterable[Path]) -> list[Results]:
    """Several files; those of one variant, size and budget as one.

    Raises:
        UserError: one cannot be read, or two of the same name have different settings.
    """
    found: dict[tuple[str, str, int], Results] = {}
    for file in files:
        new = read(file)
        old = found.setdefault((new.header.variant, new.header.size, new.header.budget), new)
        if old.header != new.header:
            raise UserError(f"{file} has other settings than another file of {new.header.text}: give one of them.")
        old.rows.update(new.rows)
    return list(found.values())


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """A 95% interval of a share (Wilson 1927)."""
    if not trials:
        return 0.0, 1.0
    share, z2 = successes / trials, Z * Z / trials
    middle = (share + z2 / 2) / (1 + z2)
    half = Z * math.sqrt(share * (1 - share) / trials + z2 / trials / 4) / (1 + z2)
    return max(0.0, middle - half), min(1.0, middle + half)


def mcnemar(only_one: int, only_other: int) -> float:
    """Exact two-sided p of levels that only one of two variants solved (McNemar 1947): a fair coin decides each."""
    flips, fewer = only_one + only_other, min(only_one, only_other)
    return min(1.0, 2 * sum(math.comb(flips, k) for k in range(fewer + 1)) / 2**flips)


def mean(values: Sequence[float | None]) -> float | None:
    """Of those that are there."""
    there = [value for value in values if value is not None]
    return sum(there) / len(there) if there else None


def share(successes: int, trials: int) -> str:
    """`41.2% (37.0 to 45.5)`: with its 95% interval."""
    if not trials:
        return "-"
    low, high = wilson(successes, trials)
    return f"{successes / trials:.1%} ({100 * low:.1f} to {100 * high:.1f})"


def count(number: float) -> str:
    """`64k`, `1M`, `1.5M`."""
    for scale, letter in ((1_000_000, "M"), (1_000, "k")):
        if number >= scale:
            return f"{number / scale:.4g}{letter}"
    return f"{number:.0f}"
