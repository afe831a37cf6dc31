"""The default procedure on more levels than the other tables have: a report, committed seeds and the sealed levels."""

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow.parquet as pq

from benchmarks.report import Table
from benchmarks.solved.results import share
from benchmarks.statistics import flips
from levelproof.experts.labels import Label
from levelproof.pipeline.learn import sealed

SEEDS = Path(__file__).parents[2] / "manifests" / "256k"
REPORT = Path(__file__).parents[1] / "results" / "report.json"  # made by make_report.py beside it
NOW, BEFORE, THOROUGH = "today's", "until 2026-11-26", "`procedure=thorough`"
SETTINGS = {"": NOW, "search.patience_gap=0.0": THOROUGH}  # of the report's splits; all others: BEFORE
COMMITTED = "s", "m", "l"  # sizes of the committed seeds of random levels, which today's defaults made
TITLE = f"**The default procedure on larger samples**, and {THOROUGH} on one of them"
HEAD = (
    "size",
    "budget",
    "levels",
    "defaults",
    "undecided levels",
    "solved (95% interval)",
    "trivial",
    "proved unsolvable",
)
PAIRED = ("size", "budget", "undecided levels", f"only the defaults {BEFORE} solve", "only today's solve", "p")


class Sample(NamedTuple):
    """Levels that a version of the default procedure labelled."""

    size: str
    budget: str
    name: str
    defaults: str
    counts: Counter[str]  # levels by label


def larger_samples() -> Table:
    """Make a row for each committed sample of levels."""
    return Table(HEAD, [row_of(sample) for sample in samples()], TITLE)


def paired() -> Table:
    """Compare the defaults before and today's on the levels of the report."""
    splits = {(_defaults(split), split["size"]): split for split in _report()["splits"]}
    rows = []
    for size in sorted((size for defaults, size in splits if defaults == BEFORE), key="sml".index):
        pairs = zip(splits[BEFORE, size]["labels"], splits[NOW, size]["labels"], strict=False)
        rows.append([size, splits[BEFORE, size]["budget"], *flips(pairs, "s", "u")])
    return Table(PAIRED, rows, "Level by level")


def samples() -> Iterator[Sample]:
    """Yield the report's levels, then the committed seeds, then the sealed levels."""
    meaning = {letter: label for label, letter in sealed.LETTERS.items()}
    labels = lambda letters: Counter(str(meaning[letter]) for letter in letters)
    report = _report()
    order = BEFORE, NOW, THOROUGH
    for split in sorted(report["splits"], key=lambda each: ("sml".index(each["size"]), order.index(_defaults(each)))):
        name = f"{len(split['labels']):,}, from id {report['first_level']:,} on"
        yield Sample(split["size"], split["budget"], name, _defaults(split), labels(split["labels"]))
    for size in COMMITTED:
        known = [label for path in sorted((SEEDS / size).glob("*.parquet")) for label in _labels(path)]
        yield Sample(size, "256k", f"{len(known):,}, `manifests/256k/{size}`", NOW, Counter(known))
    known = json.loads(Path(sealed.__file__).with_name(sealed.KNOWN).read_text())["sizes"]
    for size, of_size in known.items():
        name = f"{len(of_size['labels']):,}, sealed levels"
        yield Sample(size, "256k", name, BEFORE, labels(of_size["labels"]))


def row_of(sample: Sample) -> list[str]:
    counts = sample.counts
    solved, total = counts[Label.SOLVED], sum(counts.values())
    undecided = solved + counts[Label.UNSOLVED]
    decided = [f"{counts[label] / total:.1%}" for label in (Label.TRIVIAL, Label.UNSOLVABLE)]
    shown = sample.size, sample.budget, sample.name, sample.defaults, f"{undecided:,}", share(solved, undecided)
    return [*shown, *decided]


def _labels(path: Path) -> Sequence[str]:
    return pq.read_table(path, columns=["label"])["label"].to_pylist()


def _defaults(split: Mapping[str, Any]) -> str:
    """Say which settings made a split of the report."""
    return SETTINGS.get(split["settings"], BEFORE)


def _report() -> dict[str, Any]:
    return json.loads(REPORT.read_text())
