"""Parquet exports: rows, worlds, and omitted levels."""

from collections.abc import Iterator
from pathlib import Path

import duckdb
import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import levelproof
from levelproof.pipeline.cli.main import main
from levelproof.pipeline.exchange import parquet
from levelproof.pipeline.store.columns import COLUMNS
from levelproof.pipeline.store.formats import CONFIG_KEY
from levelproof.pipeline.store.layout import MANIFEST
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.store.seed.rows import COSTS
from tests.pipeline.made import PLAYED, honest_split, made_job


def test_export_parquet_keeps_rows_and_worlds(split: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    """Across several files that mix stored and regenerated levels."""
    manifests, real = [], parquet.require_manifest

    def recording(*args, **kwargs):
        manifests.append(real(*args, **kwargs))
        return manifests[-1]

    for name, rows in {"FILE": 40, "GROUP": 20, "CHUNK": 16}.items():
        monkeypatch.setattr(parquet, name, rows)
    monkeypatch.setattr(parquet, "require_manifest", recording)
    assert main(["export", str(split), "--format", "parquet", "-o", str(tmp_path / "levels")]) == 0
    assert capsys.readouterr().out.startswith(f"{tmp_path / 'levels'}: {PLAYED} levels. In Python: ")
    assert sorted(path.name for path in (tmp_path / "levels").iterdir()) == [
        "levels-00000.parquet",
        "levels-00001.parquet",
    ]
    assert [each.table.num_rows for each in manifests if len(each.table.column_names) > 1] == [20, 20, 20, 4]
    table = pq.read_table(tmp_path / "levels")
    assert table.select(COLUMNS.names).equals(read_manifest(split).table.replace_schema_metadata())
    made = levelproof.sample_levels(np.arange(PLAYED), levelproof.SIZES["s"], made_job().distribution)
    jax.tree.map(np.testing.assert_array_equal, levelproof.levels_from(table), made)
    fragment = next((split / MANIFEST).glob("*.parquet"))
    ours = pq.read_schema(tmp_path / "levels/levels-00000.parquet").metadata
    assert ours[CONFIG_KEY] == pq.read_schema(fragment).metadata[CONFIG_KEY]
    query = f"SELECT level_id FROM '{tmp_path}/levels/*.parquet' WHERE list_contains(role, 3) ORDER BY ALL"
    red = np.flatnonzero((np.asarray(made.role) == 3).any(0))
    assert [row[0] for row in duckdb.sql(query).fetchall()] == red.tolist()


def test_export_parquet_of_seeds_has_no_costs(tmp_path: Path) -> None:
    split, seed, out = honest_split(tmp_path, 16, 1), tmp_path / "seed.parquet", tmp_path / "levels"
    assert main(["export", str(split), "--format", "seed", "-o", str(seed)]) == 0
    assert main(["export", str(seed), "--format", "parquet", "-o", str(out)]) == 0
    table = pq.read_table(out)
    assert all(table[name].null_count == table.num_rows == 16 for name in COSTS)


def test_export_parquet_selects_levels_by_where(split: Path, tmp_path: Path, capsys) -> None:
    command = ["export", str(split), "--format", "parquet", "-o", str(tmp_path / "levels"), "--where"]
    assert main([*command, "label = 'solved'"]) == 0
    assert set(pq.read_table(tmp_path / "levels")["label"].to_pylist()) == {"solved"}
    assert main([*command, "label = 'solved'"]) == 2
    assert "already exists" in capsys.readouterr().err
    command[command.index("-o") + 1] = str(tmp_path / "others")
    assert main([*command, "level_id < 0"]) == 2
    assert capsys.readouterr().err.startswith(f"Error: No level of {split} meets the condition level_id < 0: ")
    assert not (tmp_path / "others").exists()


def test_export_parquet_omits_levels_that_differ_here(split: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    """Simulate a machine with other bits: the content hash in the row differs from that of the regenerated level."""
    first = next(row for row in read_manifest(split).table.to_pylist() if row["label"] == "unsolved")
    real = parquet.content_hashes
    monkeypatch.setattr(parquet, "content_hashes", lambda level: ["other", *real(level)[1:]])
    assert main(["export", str(split), "--format", "parquet", "-o", str(tmp_path / "levels")]) == 0
    assert f"{PLAYED - 1} levels, without 1 that differ on this machine" in capsys.readouterr().out
    assert first["level_id"] not in pq.read_table(tmp_path / "levels")["level_id"].to_pylist()


def test_row_groups_are_written_as_they_come(tmp_path: Path) -> None:
    """So that memory holds one of them, and progress is that of the file."""
    out, sizes = tmp_path / "rows.parquet", []

    def groups() -> Iterator[pa.Table]:
        for seed in range(4):
            sizes.append(out.stat().st_size if out.exists() else 0)
            yield pa.table({"x": np.random.default_rng(seed).random(10_000)})

    assert parquet._write(out, groups(), {}) == 40_000
    assert sizes[0] == 0
    assert (np.diff(sizes[1:]) > 50_000).all(), sizes
