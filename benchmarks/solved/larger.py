"""The default procedure on more levels than the other tables have: the committed seeds and the sealed levels."""

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

import pyarrow.parquet as pq

from benchmarks.report import Table
from benchmarks.solved.results import share
from levelproof.experts.labels import Label
from levelproof.pipeline.learn import sealed

SEEDS = Path(__file__).parents[2] / "manifests" / "256k"
HEAD = ("size", "levels", "undecided levels", "solved (95% interval)", "trivial", "proved unsolvable")


def larger_samples() -> Table:
    """Make a row for each committed sample of levels; all were labelled at 256k env steps."""
    rows = [row_of(size, name, counts) for size, name, counts in samples()]
    return Table(HEAD, rows, "**The default procedure at 256k env steps on larger samples**")


def samples() -> Iterator[tuple[str, str, Mapping[str, int]]]:
    """Yield size, name and number of levels of each label."""
    for folder in sorted(SEEDS.iterdir()):
        labels = [
            label for path in sorted(folder.glob("*.parquet")) for label in pq.read_table(path)["label"].to_pylist()
        ]
        yield folder.name, f"`manifests/256k/{folder.name}`", Counter(labels)
    known = json.loads(Path(sealed.__file__).with_name(sealed.KNOWN).read_text())["sizes"]
    meaning = {letter: label for label, letter in sealed.LETTERS.items()}
    for size, of_size in known.items():
        yield size, "sealed levels", Counter(meaning[letter] for letter in of_size["labels"])


def row_of(size: str, name: str, counts: Mapping[str, int]) -> list[str]:
    solved, unsolved = counts[Label.SOLVED], counts[Label.UNSOLVED]
    total, undecided = sum(counts.values()), solved + unsolved
    decided = [f"{counts[label] / total:.1%}" for label in (Label.TRIVIAL, Label.UNSOLVABLE)]
    return [size, f"{total:,}, {name}", f"{undecided:,}", share(solved, undecided), *decided]
