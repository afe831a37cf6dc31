"""First episodes: the beginnings of records, whether they are read from shards or simulated from seeds."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest

import levelproof
from levelproof.experts.witness import episode
from levelproof.pipeline.dataset.dataset import Dataset
from levelproof.pipeline.dataset.episodes import EpisodeBatch
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.exchange.seed import export_seed
from tests.pipeline.made import honest_split
from tests.trees import assert_same

CONTENT = ["level", "record"]


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return honest_split(tmp_path_factory.mktemp("split"), 16, 3)


@pytest.fixture(scope="module")
def seeds(honest: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of two seed files."""
    folder = tmp_path_factory.mktemp("seeds")
    for name, where in ("a", "level_id < 8"), ("b", "level_id >= 8"):
        export_seed(honest, where, folder / f"{name}.parquet")
    return folder


def test_episodes_are_the_beginnings_of_records(data: Dataset) -> None:
    indices = [5, 0, 5, 3]
    whole, first = data.read(indices, fields=CONTENT), data.episodes(indices, CONTENT)
    assert first.level_id.tolist() == whole.level_id.tolist()
    assert first.steps.tolist() == (whole.done.argmax(1) + 1).tolist()
    kept = np.arange(whole.done.shape[1]) < first.steps[:, None]
    np.testing.assert_array_equal(first.episode, np.repeat(np.arange(4), first.steps))
    for name in ("observation", "action", "action_mask", "reward", "done"):
        np.testing.assert_array_equal(getattr(first, name), np.asarray(getattr(whole, name))[kept], name)
    for name, values in whole.fields.items():
        np.testing.assert_array_equal(first.fields[name], values if name.startswith("level/") else values[kept], name)
    assert first.mask.all()


@pytest.mark.slow
@pytest.mark.parametrize("observation", ["symbolic_flat", "symbolic_entity", None])
def test_episodes_of_seeds_are_those_of_their_split(honest: Path, seeds: Path, observation: str | None) -> None:
    ours, theirs = levelproof.open(seeds), levelproof.open(honest)
    indices = np.arange(len(theirs))[::-1]
    fields = ["level", "record/state", "record/goal", "record/timestep", "record/last_distance"]
    mine, split = (data.episodes(indices, fields, observation) for data in (ours, theirs))
    live = split.action * split.action_mask  # seeds have no actions without an effect
    assert mine.action.tolist() == live.tolist()
    assert_same(mine, jax.tree.map(np.asarray, split.__class__(**{**vars(split), "action": mine.action})))


@pytest.mark.slow
def test_episodes_have_the_same_bits_however_many_are_played_together(
    seeds: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = levelproof.open(seeds)
    indices, fields = np.arange(len(data)), ["record/state", "record/manifold", "record/reward"]
    few = data.episodes(indices, fields, None)
    for name, value in ("FEW", 0), ("MANY", 1):
        monkeypatch.setattr(episode, name, value)
    assert_same(data.episodes(indices, fields, None), few)
    assert_same(data.episodes(indices, fields, None).parts(1)[3], data.episodes([3], fields, None))


def test_episode_batches_yield_each_episode_once(seeds: Path) -> None:
    data = levelproof.open(seeds)
    batches = [*data.episode_batches(5, seed=1, observation=None)]
    assert [len(batch.steps) for batch in batches] == [5] * -(-len(data) // 5)
    ids = np.concatenate([batch.level_id[np.unique(batch.episode[batch.mask])] for batch in batches]).tolist()
    assert sorted(ids) == data.manifest["level_id"].to_pylist() != ids
    for batch in batches:
        assert_same(batch, batch.__class__(**{**vars(data.episodes(indices_of(data, batch), (), None)),
                                               "mask": batch.mask}))  # fmt: skip


@pytest.mark.parametrize(
    ("prefetch", "observation", "most"), [(0, None, 2), (3, None, 4), (None, None, 1024), (None, "pixels", 2)]
)
def test_episode_batches_read_no_more_at_once_than_asked_for(
    data: Dataset, monkeypatch: pytest.MonkeyPatch, prefetch: int | None, observation: str | None, most: int
) -> None:
    plain, counts = data.episodes, []
    monkeypatch.setattr(data, "episodes", lambda some, *_: counts.append(len(some)) or plain(some, observation=None))
    batches = data.episode_batches(2, observation=observation, prefetch=prefetch)
    ids = np.concatenate([batch.level_id for batch in batches])
    assert set(ids.tolist()) == set(data.manifest["level_id"].to_pylist())
    assert max(counts) == min(most, 2 * -(-len(data) // 2))


def indices_of(data: Dataset, batch: EpisodeBatch) -> np.ndarray:
    return np.searchsorted(data.manifest["level_id"].to_numpy(), batch.level_id)


def test_episode_batches_resume_from_their_state(seeds: Path) -> None:
    data = levelproof.open(seeds)
    batches = data.episode_batches(3, seed=2, epochs=2, observation=None)
    next(batches)
    state = json.loads(json.dumps(batches.state()))
    rest = [batch.level_id.tolist() for batch in batches]
    again = data.episode_batches(3, seed=2, epochs=2, observation=None, start=state)
    assert [batch.level_id.tolist() for batch in again] == rest
    assert rest
    with pytest.raises(UserError, match="saved with other settings"):
        data.episode_batches(4, seed=2, epochs=2, observation=None, start=state)


def test_episodes_reject_an_index_that_does_not_exist(data: Dataset) -> None:
    with pytest.raises(UserError, match="use indices from 0"):
        data.episodes([len(data)])
