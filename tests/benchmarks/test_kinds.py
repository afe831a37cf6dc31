"""The benchmark of policies' networks, on a split of a few levels."""

from pathlib import Path

import pytest

from benchmarks import kinds
from benchmarks.__main__ import parser
from benchmarks.networks import multiply_adds
from levelproof.experts.config import ExpertConfig
from levelproof.levelgen.level import SIZES
from levelproof.pipeline.errors import UserError
from tests.pipeline.made import played_split

pytestmark = pytest.mark.campaign


def test_networks_are_timed_cloned_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    split = played_split(tmp_path / "data")
    for name, value in {"FEW": 1, "REPEATS": 1, "DRAWN": 1}.items():
        monkeypatch.setattr(kinds, name, value)
    words = ["kinds", str(split), "--kinds", "attention", "flat", "--core-seconds", "0.01", "--measured", "8"]
    args = parser("kinds").parse_args([*words, "--set", "train.batch=8", "--folder", str(tmp_path / "kept")])
    first = kinds.run(args)
    clones, paces = first.tables
    assert [row[0] for row in clones.rows] == ["attention", "flat", "random", "sticky random"]
    assert [row[0] for row in paces.rows] == [kinds.EXPERTS, "attention", "flat"]
    for table in first.tables:
        assert {len(row) for row in table.rows} == {len(table.head)}
    assert min(float(cell.replace(",", "")) for row in paces.rows for cell in row[1:4]) > 0
    kept = [*(tmp_path / "kept").glob("*.json"), *(tmp_path / "kept").glob("*/sealed-*.json")]
    before = [file.stat().st_mtime_ns for file in kept]
    assert len(kept) == 3
    assert kinds.run(args).results == first.results
    assert [file.stat().st_mtime_ns for file in kept] == before
    args.set = []
    with pytest.raises(UserError, match="choose another --folder"):
        kinds.run(args)


def test_experts_flop_are_three_forward_passes() -> None:
    counted = kinds.expert_flops(SIZES["s"], ExpertConfig())
    passes = 3 * 2 * multiply_adds("entity", SIZES["s"])
    assert 0.5 * passes < counted < 1.5 * passes
