"""What came of looking at a split: what was looked at, what is wrong, and what it takes to make that again."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from levelproof.pipeline.store.origins import Origin
from levelproof.pipeline.store.remote import as_typed
from levelproof.pipeline.store.runs import runs, told_levels
from levelproof.pipeline.words import many


@dataclass
class Findings:
    """Of a split, or of some fragments of one."""

    levels: int = 0
    shards: int = 0
    witnesses: int = 0
    same_bits: int = 0  # of the witnesses: replayed bit for bit
    wrong: dict[str, set[int]] = field(default_factory=dict)  # sentences, and the levels that each hits
    missing: list[tuple[int, int]] = field(default_factory=list)  # runs of levels that the last command wanted
    # For who repairs
    there: list[tuple[int, int]] = field(default_factory=list)  # runs of levels in fragments that are sound
    fragments: dict[Path, str] = field(default_factory=dict)  # damaged ones, and how
    unlike: set[str] = field(default_factory=set)  # shards and experts that are not what was committed
    lost: set[int] = field(default_factory=set)  # levels whose row or data is not to be believed
    origins: dict[int, Origin] = field(default_factory=dict)  # of those that no id makes
    beyond: dict[int, str] = field(default_factory=dict)  # those that cannot be made again here, and why
    budget: str = ""  # as typed
    stored: str = ""  # the settings that say how records are stored (`configs.schema.stored_as`)
    config: dict[str, Any] | None = None  # the settings that decide results

    def tell(self, sentence: str, level_ids: Iterable[int]) -> None:
        """Note something that is wrong, and the levels that have to be made again for it."""
        self.wrong.setdefault(sentence, set()).update(level_ids)
        self.lost.update(self.wrong[sentence])

    @property
    def sentences(self) -> list[str]:
        """What is wrong, each with the levels that it hits."""
        return [
            sentence if sentence.startswith("Level ") or not level_ids else f"{sentence[:-1]} ({_levels(level_ids)})."
            for sentence, level_ids in self.wrong.items()
        ]

    def report(self, split: Path) -> str:
        """A line for everything that is wrong, and what was looked at."""
        where = as_typed(split)
        looked = (
            f"{where}: {many(self.levels, 'level')} made again, {many(self.shards, 'shard')} read, "
            f"{many(self.witnesses, 'witness')} replayed, {self.same_bits:,} of them bit for bit, "
            f"{many(len(self.wrong), 'problem')}."
        )
        return "\n".join([*self.sentences, looked])

    def as_json(self) -> dict[str, Any]:
        counts = {name: getattr(self, name) for name in ("levels", "shards", "witnesses", "same_bits")}
        wrong = [{"what": sentence, "levels": runs(sorted(ids))} for sentence, ids in self.wrong.items()]
        return counts | {"wrong": wrong, "missing": self.missing}


def _levels(level_ids: Iterable[int]) -> str:
    return f"it hits {told_levels(runs(sorted(level_ids)))}"
