"""The benchmark of cloning, on a split of a few levels."""

from pathlib import Path

import pytest

from benchmarks.__main__ import parser
from benchmarks.cloning import BASELINES, run
from levelproof.pipeline.store.manifest import require_manifest
from tests.pipeline.made import played_split

pytestmark = pytest.mark.campaign


def test_cloning_measures_policies_and_keeps_them(tmp_path: Path) -> None:
    split = played_split(tmp_path / "data")
    solved = require_manifest(split, ["label"]).table["label"].to_pylist().count("solved")
    words = ["cloning", str(split), "--levels", str(solved), "--seeds", "2", "--updates", "2", "--measured", "8"]
    words += ["--mirrored", str(solved), "--longer", str(solved)]
    args = parser("cloning").parse_args([*words, "--folder", str(tmp_path / "kept")])
    first = run(args)
    names = [str(solved), f"{solved}, mirrored", f"{solved}, twice the updates"]
    assert [row[:2] for row in first.tables[0].rows] == [[name, n] for name, n in zip(names, "211", strict=True)]
    assert len(first.tables[1].rows) == len(BASELINES)
    for name, draw in first.plots.items():
        draw(tmp_path / name)
        assert (tmp_path / name).read_text().rstrip().endswith("</svg>")
    kept = sorted((tmp_path / f"kept/s-{solved}-0").glob("se*-*.json"))
    assert [file.name.partition("-")[0] for file in kept] == ["sealed", "seen"]
    before = [file.stat().st_mtime_ns for file in kept]
    assert run(args).results == first.results
    assert [file.stat().st_mtime_ns for file in kept] == before
    args.measured = 4
    assert {each["sealed"]["all"]["random"]["levels"] for each in run(args).results} == {4}, "not those of 8"
