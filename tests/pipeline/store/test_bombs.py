"""Small files that decompress to large ones, and endless files: each is refused in one sentence, in little memory."""

import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from levelproof.experts.labels import Label
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.checkpoints import load_experts
from levelproof.pipeline.store.fragment import read_fragment
from levelproof.pipeline.store.manifest import fragment_paths
from levelproof.pipeline.store.shard import Shard
from tests.pipeline.made import made_job, made_split

pytestmark = pytest.mark.slow

MAX_MEMORY = 2**27  # bytes


def refused(shard: Path) -> str:
    """Return the message that refuses a shard, and check that refusing took little memory."""
    tracemalloc.start()
    try:
        with pytest.raises(Failure) as raised:
            Shard(shard).read()
        assert tracemalloc.get_traced_memory()[1] < MAX_MEMORY
    finally:
        tracemalloc.stop()
    return str(raised.value)


@pytest.fixture
def split(tmp_path: Path) -> Path:
    return made_split(tmp_path, [[Label.SOLVED, Label.SOLVED]])


def test_shard_refuses_huge_metadata(split: Path) -> None:
    (shard,) = (split / "shards").iterdir()
    for name in ("dyn32/zarr.json", "zarr.json"):
        with (shard / name).open("r+b") as file:
            file.truncate(2**30)
        assert f"its {name} is larger than any shard" in refused(shard)


def test_load_experts_refuses_compressed_pickled_files_and_folders(tmp_path: Path) -> None:
    job, path = made_job(), tmp_path / "experts.npz"
    np.savez_compressed(path, level_id=np.zeros(10**7, np.int64))
    assert path.stat().st_size < 10**6
    with pytest.raises(Failure, match="it is compressed, which experts never are"):
        load_experts(path, job)
    np.savez(path, level_id=np.array([{}], object), curve=np.zeros((1, 1)))
    with pytest.raises(Failure, match="cannot be read"):
        load_experts(path, job)
    with zipfile.ZipFile(path, "w") as archive:
        header = b"{'descr': '<i8', 'fortran_order': False, 'shape': (10000000000000,), }"
        archive.writestr("level_id.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    with pytest.raises(Failure, match="cannot be read"):
        load_experts(path, job)
    path.unlink()
    path.mkdir()  # as Orbax stores checkpoints
    (path / "_METADATA").write_text("{}")
    with pytest.raises(Failure, match="it is not a file"):
        load_experts(path, job)


def test_load_experts_refuses_invalid_level_ids(tmp_path: Path) -> None:
    for level_ids, curves in ((7, [[0.0]]), ([0.5], [[0.0]]), ([1], [0.0]), ([1, 2], [[0.0]])):
        np.savez(tmp_path / "experts.npz", level_id=np.array(level_ids), curve=np.array(curves))
        with pytest.raises(Failure, match="cannot be read"):
            load_experts(tmp_path / "experts.npz", made_job())


@pytest.mark.parametrize("text", [b"[[]]", b'{"a": 7}', b"[" * 100_000, b"7"])
def test_read_fragment_refuses_invalid_digests(split: Path, text: bytes) -> None:
    (path,) = fragment_paths(split)
    table = pq.read_table(path)
    pq.write_table(table.replace_schema_metadata(table.schema.metadata | {b"levelproof.sha256": text}), path)
    with pytest.raises(Failure, match="is damaged"):
        read_fragment(path)


def test_shard_refuses_an_index_with_a_huge_chunk(split: Path) -> None:
    """A sparse file of a terabyte, which one chunk claims to fill."""
    from google_crc32c import value

    (shard,) = (split / "shards").iterdir()
    file = shard / "dyn32/c/0/0/0"
    index = np.array([[0, 2**40], [0, 2**40]], "<u8").tobytes()
    with file.open("r+b") as out:
        out.truncate(2**40)
        out.seek(0, 2)
        out.write(index + value(index).to_bytes(4, "little"))
    assert "are missing or have changed" in refused(shard)
    assert Shard(shard).level_ids.tolist() == [0, 1]
