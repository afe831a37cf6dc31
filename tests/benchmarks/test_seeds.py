"""The benchmark of seeds, on the seed file of a few levels."""

from pathlib import Path

import pytest

from benchmarks.__main__ import parser
from benchmarks.seeds import run
from levelproof.pipeline.exchange.seed import export_seed
from levelproof.pipeline.store.manifest import require_manifest
from tests.pipeline.made import honest_split

pytestmark = pytest.mark.campaign


def test_bytes_add_up_and_every_way_reads(tmp_path: Path) -> None:
    split, seeds = honest_split(tmp_path / "data", 32, 1), tmp_path / "levels.parquet"
    export_seed(split, None, seeds)
    args = parser("seeds").parse_args(["seeds", str(seeds), "--seconds", "0.1", "--without-reference"])
    (stored,) = run(args).results
    rates = stored["rates"]
    assert sum(stored["columns"].values()) == stored["bytes"] == seeds.stat().st_size
    names = ["released data", "`full`", "`resume`", "`witness`", "`seed`"]
    assert [*stored["per_trajectory"]] == names
    sizes = [*stored["per_trajectory"].values()]
    assert sizes == sorted(sizes, reverse=True), "each density takes less than the one before"
    labels = require_manifest(split, ["label"]).table["label"].to_pylist()
    assert (stored["levels"], stored["solved"]) == (len(labels), labels.count("solved"))
    kinds = [f"{name}, {what}" for name in ("seeds", "full") for what in ("records", "first episodes")]
    assert min(rates[name]["transitions"] for name in (*kinds, "Lanes")) > 0
