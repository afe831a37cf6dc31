"""Result of verifying a split: what was checked, what is wrong, and what a repair needs."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from levelproof.configs.schema import FROM_RECORDS, is_grown
from levelproof.pipeline.store.origins import Origin
from levelproof.pipeline.store.runs import runs, runs_text
from levelproof.pipeline.store.seed.file import is_seed
from levelproof.pipeline.urls import as_typed, quoted
from levelproof.pipeline.words import many

COUNTS = ("levels", "shards", "witnesses", "same_bits")


@dataclass
class Findings:
    """Findings about a split."""

    levels: int = 0
    shards: int = 0
    witnesses: int = 0
    same_bits: int = 0  # witnesses replayed bit for bit
    wrong: dict[str, set[int]] = field(default_factory=dict)  # sentences, and the levels that each affects
    missing: list[tuple[int, int]] = field(
        default_factory=list
    )  # runs of levels that the last command requested, and no fragment has
    # For repairs
    examined: set[tuple[Path, int]] = field(default_factory=set)  # fragments, as in `layout.fragment_files`
    present: list[tuple[int, int]] = field(default_factory=list)  # runs of levels in sound fragments
    fragments: dict[Path, str] = field(default_factory=dict)  # damaged fragments, and why
    changed: set[str] = field(default_factory=set)  # shards and experts that differ from what was committed
    lost: set[int] = field(default_factory=set)  # levels whose row or data is wrong or missing
    origins: dict[int, Origin] = field(default_factory=dict)  # of lost levels that come from files
    unrepairable: dict[int, str] = field(default_factory=dict)  # lost levels that this machine cannot remake, and why
    budget: str = ""  # as the user typed it
    stored: str = ""  # settings of how records are stored (`configs.schema.stored_as`)
    names_experts: bool = False  # whether sound fragments name kept experts, lost or not
    config: dict[str, Any] | None = None  # settings that decide results

    def add(self, sentence: str, level_ids: Iterable[int]) -> None:
        """Add a sentence on what is wrong, and the levels that must be remade."""
        self.wrong.setdefault(sentence, set()).update(level_ids)
        self.lost.update(self.wrong[sentence])

    def include(self, other: "Findings") -> None:
        """Add the findings about a part of the split."""
        for name in COUNTS:
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for sentence, level_ids in other.wrong.items():
            self.wrong.setdefault(sentence, set()).update(level_ids)
        self.fragments |= other.fragments
        self.changed |= other.changed
        self.lost |= other.lost
        self.origins |= other.origins
        self.unrepairable |= other.unrepairable
        self.budget, self.stored = other.budget or self.budget, other.stored or self.stored
        self.config = other.config or self.config

    @property
    def sentences(self) -> list[str]:
        """What is wrong, with the affected levels."""
        return [
            sentence if sentence.startswith("Level ") or not level_ids else f"{sentence[:-1]} ({_levels(level_ids)})."
            for sentence, level_ids in self.wrong.items()
        ]

    def report(self, split: Path) -> str:
        """Return one line per problem, and a summary of what was checked."""
        summary = (
            f"{as_typed(split)}: {many(self.levels, 'level')} regenerated, {many(self.shards, 'shard')} read, "
            f"{many(self.witnesses, 'witness')} replayed, {self.same_bits:,} of them bit for bit, "
            f"{many(len(self.wrong), 'problem')}."
        )
        return "\n".join([*self.sentences, summary])

    def as_json(self) -> dict[str, Any]:
        """Return the findings for `verify --json`."""
        counts = {name: getattr(self, name) for name in COUNTS}
        wrong = [{"what": sentence, "levels": runs(sorted(ids))} for sentence, ids in self.wrong.items()]
        return counts | {"wrong": wrong, "missing": self.missing}


def why_not_repaired(split: Path, findings: Findings) -> str | None:
    """Say why `verify --repair` cannot remake a split's levels, whose actions came from elsewhere; None: it can."""
    config = findings.config or {}
    if is_seed(split):
        return f"{split} is a seed file, which is not repaired: copy it again from its source."
    if is_grown(config):
        return (
            f"The split {split} was grown from seed files, so it is not repaired: delete it and run `levelproof grow` "
            "again."
        )
    if config.get("distribution") == FROM_RECORDS:
        return (
            f"The split {split} was imported, so its levels cannot be regenerated: delete it, and import its folder of "
            f"trajectories again with `levelproof import FOLDER -o {quoted(split)}`."
        )
    return None


def _levels(level_ids: Iterable[int]) -> str:
    return f"affects {runs_text(runs(sorted(level_ids)))}"
