"""Digests detect any changed byte of a fragment and of the data that it commits."""

import json
import subprocess
from pathlib import Path

import duckdb
import pyarrow.parquet as pq
import pytest

from levelproof.experts.labels import Label
from levelproof.pipeline.store.checksums import digests_of, has_own
from levelproof.pipeline.store.fragment import read_fragment
from levelproof.pipeline.store.layout import data_path
from levelproof.pipeline.store.manifest import fragment_paths
from tests.pace import patience
from tests.pipeline.made import made_split


@pytest.fixture
def split(tmp_path: Path) -> Path:
    return made_split(tmp_path, [[Label.SOLVED, Label.UNSOLVED]])


def test_has_own_detects_any_changed_byte(split: Path) -> None:
    (path,) = fragment_paths(split)
    assert has_own(path)
    whole = path.read_bytes()
    for at in (*range(0, len(whole), 101), *range(len(whole) - 60, len(whole))):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1 << at % 8]) + whole[at + 1 :])
        assert not has_own(path), at
    for end in (0, 3, 8, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:end])
        assert not has_own(path)
    path.write_bytes(whole + b"\0")
    assert not has_own(path)


def test_fragments_with_digests_are_plain_parquet(split: Path) -> None:
    (path,) = fragment_paths(split)
    with pq.ParquetFile(path, page_checksum_verification=True) as file:
        assert file.read().column("level_id").to_pylist() == [0, 1]
    assert duckdb.sql(f"SELECT level_id, label FROM '{path}' ORDER BY 1").fetchall() == [(0, "solved"), (1, "unsolved")]


def test_fragments_have_the_digests_of_their_shards(split: Path) -> None:
    """`sha256sum` computes the same ones."""
    fragment, rows = read_fragment(*fragment_paths(split))
    name = rows.column("shard")[0].as_py()
    shard = data_path(split, name)
    assert fragment.digests == {name: digests_of(shard)}
    assert json.loads(rows.schema.metadata[b"levelproof.sha256"]) == fragment.digests
    listed = "".join(f"{digest}  {file}\n" for file, digest in fragment.digests[name].items())
    subprocess.run(
        ["sha256sum", "--check", "--strict"], cwd=shard, input=listed, text=True, check=True, timeout=patience(1800)
    )


def test_digests_of_depends_on_names_lengths_and_links(split: Path) -> None:
    fragment, _ = read_fragment(*fragment_paths(split))
    ((name, digests),) = fragment.digests.items()
    shard = split / name
    (shard / "act").rename(shard / "cat")
    assert digests_of(shard) != digests
    (shard / "cat").rename(shard / "act")
    assert digests_of(shard) == digests
    (shard / "more").touch()
    assert digests_of(shard).keys() - digests.keys() == {"more"}
    (shard / "more").unlink()
    (shard / "zarr.json").rename(split / "elsewhere")
    (shard / "zarr.json").symlink_to(split / "elsewhere")
    assert digests_of(shard) == digests | {"zarr.json": "no file"}
