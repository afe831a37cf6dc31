"""Rows of large seed files, which the processes of a loader share: the same rows, from one file, opened quickly."""

import multiprocessing
import os
import pickle
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import levelproof
from levelproof.pipeline.dataset import trajectories
from levelproof.pipeline.dataset.dataset import Dataset
from levelproof.pipeline.exchange.seed import export_seed
from levelproof.pipeline.runtime import CACHE_VARIABLE
from levelproof.pipeline.store import mapped, named
from levelproof.pipeline.store.seed import shard
from levelproof.pipeline.store.seed.shard import SeedShard
from tests.pipeline.made import honest_split

WHERE = "level_id > 2"


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("seeds") / "levels.parquet"
    export_seed(honest_split(tmp_path_factory.mktemp("split"), 16, 2), None, path)
    return path


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Share tables of any size, in a folder of this test alone."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(mapped, "MIN_BYTES", 0)
    named._seed_shard.cache_clear()
    return tmp_path / "cache" / mapped.FOLDER


def states(folder: Path) -> dict[str, tuple[int, int]]:
    return {path.name: (path.stat().st_ino, path.stat().st_size) for path in folder.iterdir()}


def rows_of(one: SeedShard) -> list[list]:
    return [one.level_ids.tolist(), one.steps.tolist(), one.checksum.tolist(), one.witness.to_pylist()]


def all_rows(data: Dataset) -> list[list]:
    opened = named.open_shard(data.split, data.split.name, "s")
    assert isinstance(opened, SeedShard)
    return [*data.manifest.to_pydict().values(), *rows_of(opened)]


def read(data: Dataset) -> list[np.ndarray]:
    batch = data.read(np.arange(len(data)), observation=None)
    return [batch.level_id, batch.action, batch.reward, batch.mask]


def test_shared_rows_are_those_that_are_read(seeds: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = rows_of(SeedShard(seeds))
    with monkeypatch.context() as patch:
        patch.setattr(mapped, "MIN_BYTES", 2**40)
        assert rows_of(SeedShard(seeds)) == plain
    monkeypatch.setattr(shard, "read_seed", None)  # not read again
    assert rows_of(SeedShard(seeds)) == plain
    assert len(states(folder)) == 1


def test_rows_of_a_file_that_is_written_again_are_read_again(seeds: Path, folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.parquet"
    copy.write_bytes(seeds.read_bytes())
    assert len(SeedShard(copy).level_ids) == 32
    copy.unlink()
    export_seed(seeds, "level_id < 8", copy)
    assert len(SeedShard(copy).level_ids) == 8


def in_worker(pickled: bytes) -> tuple[list[list], list[int]]:
    """Return the rows of a dataset and its file, and the inodes of the tables that are mapped."""
    mapped.MIN_BYTES = 0
    trajectories.require_manifest = shard.read_seed = None  # type: ignore[assignment]  # nothing is read again
    data = pickle.loads(pickled)
    rows = all_rows(data)
    maps = Path("/proc/self/maps").read_text().splitlines()
    return rows, sorted({int(line.split()[4]) for line in maps if line.endswith(mapped.SUFFIX)})


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="this system does not list maps")
def test_processes_of_a_loader_map_the_same_files(seeds: Path, folder: Path) -> None:
    data = levelproof.open(seeds, where=WHERE)
    expected = all_rows(data)
    files = sorted(inode for inode, _ in states(folder).values())
    assert len(files) == 2
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as workers:
        for rows, inodes in workers.map(in_worker, [pickle.dumps(data)] * 2):
            assert rows == expected
            assert inodes == files
    assert sorted(inode for inode, _ in states(folder).values()) == files


def test_reopened_dataset_is_the_one_that_was_opened(seeds: Path, folder: Path) -> None:
    data = levelproof.open(seeds, where=WHERE, columns=["success_rate"])
    again = pickle.loads(pickle.dumps(data))
    assert again.manifest.equals(data.manifest)
    assert (again.rules, again.simulates, again.size) == (data.rules, data.simulates, data.size)
    assert len(states(folder)) == 1


def test_damaged_tables_are_written_again(seeds: Path, folder: Path) -> None:
    data = levelproof.open(seeds, where=WHERE)
    expected, before = read(data), states(folder)
    pickled = pickle.dumps(data)
    for path in folder.iterdir():
        content = path.read_bytes()
        path.unlink()
        path.write_bytes(content[:-100])
    named._seed_shard.cache_clear()
    for ours, theirs in zip(read(pickle.loads(pickled)), expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert {name: size for name, (_, size) in states(folder).items()} == {n: size for n, (_, size) in before.items()}


def open_first(path: Path, cache: Path) -> list[list]:
    os.environ[CACHE_VARIABLE], mapped.MIN_BYTES = str(cache), 0
    return all_rows(levelproof.open(path))


@pytest.mark.slow
def test_concurrent_first_opens_do_not_conflict(seeds: Path, folder: Path) -> None:
    with ProcessPoolExecutor(3, multiprocessing.get_context("spawn")) as workers:
        first, *others = workers.map(open_first, [seeds] * 6, [folder.parent] * 6)
    assert others == [first] * 5
    assert {Path(name).suffix for name in states(folder)} == {mapped.SUFFIX}
    assert len(states(folder)) == 2


def test_content_hashes_are_made_once(seeds: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = levelproof.open(seeds)
    hashes = data.content_hashes
    monkeypatch.setattr(trajectories, "require_manifest", None)
    again = pickle.loads(pickle.dumps(data))
    assert again.content_hashes == hashes
    table = levelproof.read_manifest(seeds, ["content_hash"], data.manifest["level_id"].to_pylist()).table
    assert hashes == table["content_hash"].to_pylist()
