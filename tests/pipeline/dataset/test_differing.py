"""Levels whose bits differ on this machine: reported once, counted, and kept, left out or refused."""

import pickle
import shutil
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import levelproof
from levelproof.pipeline.dataset.dataset import Dataset
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.exchange.seed import export_seed
from levelproof.pipeline.store.density import CHECKSUM
from levelproof.pipeline.store.seed.packed import pack_witness
from levelproof.pipeline.store.shard import Shard
from tests.pipeline.made import honest_split
from tests.pipeline.store.test_density import changed
from tests.pipeline.store.test_seed import rewritten

WRONG = [1, 4]  # indices of the trajectories whose stored checksums no engine computes
WAYS = ["keep", "leave_out"]


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return honest_split(tmp_path_factory.mktemp("split"), 16, 2, "density=witness")


@pytest.fixture(scope="module")
def ids(honest: Path) -> list[int]:
    """Return the levels of WRONG."""
    return levelproof.open(honest).manifest["level_id"].take(WRONG).to_pylist()


@pytest.fixture(scope="module")
def seeds(honest: Path, ids: list[int], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("seeds")
    export_seed(honest, None, folder / "good.parquet")
    table = pq.read_table(folder / "good.parquet")
    sums = table["checksum"].to_pylist()
    for row in np.flatnonzero(np.isin(table["level_id"].to_numpy(), ids)).tolist():
        sums[row] ^= 1
    return rewritten(folder / "good.parquet", folder / "wrong.parquet", checksum=sums)


@pytest.fixture(scope="module")
def shards(honest: Path, ids: list[int], tmp_path_factory: pytest.TempPathFactory) -> Path:
    split = Path(shutil.copytree(honest, tmp_path_factory.mktemp("shards") / honest.parent.name / honest.name))
    for row in levelproof.open(split).manifest.take(WRONG).to_pylist():

        def change(stored: dict[str, np.ndarray], at: int = row["row"]) -> None:
            stored[CHECKSUM][0, at] ^= 1

        changed(Shard(split / row["shard"]), change)
    return split


@pytest.fixture(params=["seeds", "shards"])
def source(request: pytest.FixtureRequest) -> Path:
    return request.getfixturevalue(request.param)


@pytest.fixture
def warned() -> Iterator[list[warnings.WarningMessage]]:
    """Return all warnings of the test, in whatever thread."""
    with warnings.catch_warnings(record=True) as messages:
        warnings.simplefilter("always")
        yield messages


def masked(batch: levelproof.Batch) -> list[int]:
    return batch.level_id[~batch.mask.any(1)].tolist()


def left_out(batch: levelproof.EpisodeBatch) -> set[int]:
    return {*batch.level_id[batch.episode[~batch.mask]].tolist()}


@pytest.mark.parametrize("way", WAYS)
def test_reading_reports_differing_levels_once(
    source: Path, ids: list[int], way: str, warned: list[warnings.WarningMessage]
) -> None:
    data = levelproof.open(source, differing=way)
    assert data.read([0, 2], observation=None).mask.all()
    assert (data.differing.tolist(), warned) == ([], [])
    batch = data.read([4, 0, 1, 4], length=100, observation=None)
    assert masked(batch) == ([ids[1], ids[0], ids[1]] if way == "leave_out" else [])
    assert batch.mask[1].all()
    assert data.differing.tolist() == ids
    assert data[1].mask.any() == (way == "keep")
    assert left_out(data.episodes([0, 1, 2])) == ({ids[0]} if way == "leave_out" else set())
    data.state(1, 3)
    (one,) = warned
    assert one.category is levelproof.EngineDiffers
    assert str(one.message).startswith(
        "On this machine the engine computes states that differ from the stored ones for 2 levels of "
        f"{source} so far, such as level {ids[1]}: "
    )


def assert_read_thrice(data: Dataset, kept: list[np.ndarray], ids: list[int], way: str) -> None:
    """Check that three epochs have every level, but those that differ only where they are kept."""
    every = data.manifest["level_id"].to_pylist()
    assert sorted(np.concatenate(kept).tolist()) == sorted(3 * [i for i in every if way == "keep" or i not in ids])
    assert data.differing.tolist() == ids


@pytest.mark.parametrize("way", WAYS)
def test_batches_of_several_epochs_report_once_and_keep_their_shape(
    source: Path, ids: list[int], way: str, warned: list[warnings.WarningMessage]
) -> None:
    data = levelproof.open(source, differing=way)
    batches = [*data.batches(3, seed=1, epochs=3, observation=None)]
    assert {batch.mask.shape for batch in batches} == {(3, 256)}
    assert_read_thrice(data, [batch.level_id[batch.mask.all(1)] for batch in batches], ids, way)
    assert len(warned) == 1


@pytest.mark.parametrize("way", WAYS)
def test_episode_batches_of_several_epochs_report_once(
    source: Path, ids: list[int], way: str, warned: list[warnings.WarningMessage]
) -> None:
    data = levelproof.open(source, differing=way)
    batches = [*data.episode_batches(3, seed=1, epochs=3, observation=None)]
    assert {len(batch.steps) for batch in batches} == {3}
    kept = [np.unique(batch.level_id[batch.episode[batch.mask]]) for batch in batches]
    assert_read_thrice(data, kept, ids, way)
    assert len(warned) == 1


def test_sources_of_loaders_mask_what_is_left_out(source: Path) -> None:
    loaded = pickle.loads(pickle.dumps(levelproof.open(source, differing="leave_out").grain(observation=None)))
    with pytest.warns(levelproof.EngineDiffers):
        assert [element["mask"].any() for element in loaded.__getitems__([0, 1, 2])] == [True, False, True]


READS: dict[str, Callable[[Dataset], object]] = {
    "read": lambda data: data.read([0, 1]),
    "getitem": lambda data: data[1],
    "episodes": lambda data: data.episodes([1]),
    "state": lambda data: data.state(1),
    "batches": lambda data: [*data.batches(4, observation=None)],
    "episode_batches": lambda data: [*data.episode_batches(4, observation=None)],
}


@pytest.mark.parametrize("name", READS)
def test_raise_refuses_differing_levels_each_time(source: Path, ids: list[int], name: str) -> None:
    data = levelproof.open(source, differing="raise")
    data.read([0, 2], observation=None)
    for _ in range(2):
        with pytest.raises(Failure, match=rf"of {source} so far, such as level {ids[0]}: read the split"):
            READS[name](data)


def test_warnings_that_are_errors_are_raised_each_time(source: Path) -> None:
    data = levelproof.open(source)
    with warnings.catch_warnings():
        warnings.simplefilter("error", levelproof.EngineDiffers)
        for _ in range(2):
            with pytest.raises(levelproof.EngineDiffers):
                data.read([1], observation=None)


def test_episodes_of_seeds_end_where_they_were_stored_to_end(honest: Path, tmp_path: Path) -> None:
    """Even if no state here reaches the goal, rows after the last one are of the next episode."""
    export_seed(honest, None, tmp_path / "good.parquet")
    table = pq.read_table(tmp_path / "good.parquet")
    asleep = [
        None if steps is None else pack_witness(np.zeros((steps, 6), np.int8), np.zeros(6, bool))
        for steps in table["steps_to_goal"].to_pylist()
    ]
    data = levelproof.open(rewritten(tmp_path / "good.parquet", tmp_path / "asleep.parquet", witness=asleep))
    steps = data.manifest["steps_to_goal"].to_numpy()
    with pytest.warns(levelproof.EngineDiffers):
        batch = data.read(np.arange(len(data)), observation=None)
    assert (batch.reward.max(1) < 0.5).any(), "some do not reach it"
    ends = (np.arange(256) + 1) % steps[:, None] == 0
    assert np.array_equal(batch.done, ends)
    assert np.array_equal(batch.terminated, ends)
    assert not batch.truncated.any()


def test_seeds_are_not_made_of_states_that_differ(shards: Path, ids: list[int], tmp_path: Path) -> None:
    advice = rf'leave them out with `levelproof export --format seed --where "level_id NOT IN \({ids[0]}, {ids[1]}\)"`'
    with pytest.raises(Failure, match=advice):
        export_seed(shards, None, tmp_path / "seeds.parquet")
    assert not (tmp_path / "seeds.parquet").exists()
    export_seed(shards, f"level_id NOT IN ({ids[0]}, {ids[1]})", tmp_path / "seeds.parquet")


def test_open_refuses_another_way(seeds: Path) -> None:
    with pytest.raises(UserError, match="differing is 'skip': use one of keep, leave_out, raise"):
        levelproof.open(seeds, differing="skip")
