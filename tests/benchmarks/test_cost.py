"""The benchmark of a solved level's cost, beside an earlier commit."""

import pytest

from benchmarks.__main__ import main, parser
from benchmarks.cost import EARLIER, NOW, reported, run
from benchmarks.report import Run, as_page
from levelproof.experts.labels import Label

JOB = "size=s budget=3k levels=8 first_level=1100000 procedure=label search.env_steps=2048"


def test_report_has_costs_and_compares_labels_level_by_level() -> None:
    solved, unsolved, trivial = Label.SOLVED, Label.UNSOLVED, Label.TRIVIAL
    earlier = {1: solved, 2: unsolved, 3: unsolved, 4: unsolved, 5: trivial, 6: unsolved}
    now = {1: unsolved, 2: solved, 3: solved, 4: unsolved, 5: trivial, 6: trivial}
    stages = {solved: {"search": 0.5, "training": 1.0, "evaluation": 0.25, "replay": 0.1}}
    stages[unsolved] = {"search": 1.5, "training": 0.0, "evaluation": 0.15, "replay": 0.0}
    results = [
        {"job": "size=s", "version": EARLIER, "seconds": 3.0, "labels": earlier, "stages": {}},
        {"job": "size=s", "version": NOW, "seconds": 5.0, "labels": now, "stages": stages},
    ]
    page = as_page(report := reported("0318eda", ["size=s"], results), Run.now("cost", ["cost"], report))
    assert "| `size=s` | 0318eda | 3 | 5 | 20.0% (3.6 to 62.4) | 3.000 |" in page
    assert "| `size=s` | today's | 5 | 4 | 50.0% (15.0 to 85.0) | 2.500 |" in page
    assert "| `size=s` | 4 | 1 | 2 | 1 |" in page
    assert "| `size=s` | today's | 0.250 | 0.750 | 0.500 | 0.000 | 0.200 | 0.050 | 0.750 |" in page


def test_unknown_commit_is_the_callers_mistake(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["cost", "--against", "nothing"]) == 2
    assert "--against nothing: this clone has no such commit" in capsys.readouterr().err


@pytest.mark.campaign
def test_a_commit_and_itself_label_alike() -> None:
    report = run(parser("cost").parse_args(["cost", "--against", "HEAD", "--jobs", JOB]))
    earlier, now = report.results
    assert len(earlier["labels"]) == 8
    assert Label.SOLVED in earlier["labels"].values()
    assert earlier["labels"] == now["labels"]
    assert min(earlier["seconds"], now["seconds"]) > 0
    assert now["stages"][Label.SOLVED]["search"] > 0
