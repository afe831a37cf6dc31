"""Witnesses as a Minari dataset: opened by the library, and equal to what the environment gives."""

import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import minari
import numpy as np
import pytest

import levelproof
from levelproof.experts.witness.witness import Record
from levelproof.levelgen.task.actions import CHOICES, continuous_controls, controls
from levelproof.levelgen.task.observe.flat import symbolic_flat
from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.cli.main import main
from levelproof.pipeline.exchange.minari.episodes import ActionKind, episodes_of, written
from levelproof.pipeline.store.fields import tree_of
from levelproof.pipeline.store.manifest import read_manifest
from tests.pipeline.made import made_job, played_split

pytestmark = pytest.mark.slow
MANY = 16  # levels of the split that are looked at, and those of them that are solved
EVERY = np.stack(np.unravel_index(np.arange(np.prod(CHOICES)), CHOICES), -1)  # action there is


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return played_split(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def stored(split: Path) -> dict[int, Any]:
    """What shards have of the first solved levels, by their ids."""
    rows = read_manifest(split).table.to_pylist()
    solved = [row for row in rows if row["label"] == "solved" and row["level_id"] < MANY]
    return {row["level_id"]: levelproof.Shard(split / row["shard"]).read([row["row"]]) for row in solved}


def exported(split: Path, out: Path, monkeypatch: pytest.MonkeyPatch, *words: str) -> Any:
    assert main(["export", str(split), "--format", "minari", "-o", str(out), *words]) == 0
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(out))
    (name,) = minari.list_local_datasets()
    return minari.load_dataset(name)


@jax.jit
def seen(level: levelproof.Level, states: Any, step: int) -> Any:
    return symbolic_flat(level, jax.tree.map(lambda x: jnp.asarray(x)[step], states))


def test_minari_opens_it(split: Path, stored: dict[int, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every step of every record is there once, in order, and what is seen is that of the stored states."""
    data = exported(split, tmp_path / "out", monkeypatch, "--where", f"label = 'solved' AND level_id < {MANY}")
    assert data.id == "levelproof/128k/s-v0"
    assert data.total_steps == 256 * len(stored)
    at = dict.fromkeys(stored, 0)
    for episode in data.iterate_episodes():
        (level_id,) = set(episode.infos["level_id"].tolist())
        fields, first = stored[level_id], at[level_id]
        rows, at[level_id] = slice(first, first + len(episode)), first + len(episode)
        level = tree_of(levelproof.Level, fields, "level/")
        record = tree_of(Record, fields, "record/")
        np.testing.assert_array_equal(episode.actions, record.action[rows, :, 0])
        np.testing.assert_array_equal(episode.rewards, record.reward[rows, 0])
        np.testing.assert_array_equal(episode.terminations, record.done[rows, 0])
        assert episode.truncations[-1] == (not record.done[rows, 0][-1])
        assert not episode.truncations[:-1].any()
        np.testing.assert_array_equal(episode.infos["success"], [False, *record.goal[rows, 0]])
        assert all(map(data.action_space.contains, episode.actions))
        assert all(map(data.observation_space.contains, episode.observations))
        np.testing.assert_array_equal(episode.observations[0], seen(level, record.state, first)[:, 0])
    assert set(at.values()) == {256}


def test_what_is_seen_last_is_what_the_next_state_is_like(stored: dict[int, Any]) -> None:
    """Within an episode the step that the engine makes anew leads to the row that the record has."""
    fields = next(iter(stored.values()))
    level, record = tree_of(levelproof.Level, fields, "level/"), tree_of(Record, fields, "record/")
    whole = lambda of: next(episodes_of(np.array([0]), level, of, TaskParams(), ActionKind.COMBINED))
    cut = record.done.copy()
    cut[5] = True
    shorter = Record(**vars(record) | {"done": cut})
    assert len(whole(record).rewards) > 6
    np.testing.assert_array_equal(whole(shorter).observations, whole(record).observations[:7])


def test_time_that_is_up_is_a_truncation_and_a_failure_is_none(stored: dict[int, Any]) -> None:
    fields = next(iter(stored.values()))
    level, record = tree_of(levelproof.Level, fields, "level/"), tree_of(Record, fields, "record/")
    done, goal = np.zeros((256, 1), bool), np.zeros((256, 1), bool)
    done[[9, 19]] = True
    timestep = np.arange(256, dtype=np.int32)[:, None] % 10
    never = Record(**vars(record) | {"done": done, "goal": goal, "timestep": timestep})
    first, second, rest = episodes_of(np.array([7]), level, never, TaskParams(max_timesteps=10), ActionKind.COMBINED)
    assert first.truncations.tolist() == second.truncations.tolist() == [False] * 9 + [True]
    assert not first.terminations.any()
    assert (len(rest.rewards), rest.truncations.sum(), rest.truncations[-1]) == (236, 1, True)
    failed, *_ = episodes_of(np.array([7]), level, never, TaskParams(), ActionKind.COMBINED)
    assert failed.terminations.tolist() == [False] * 9 + [True]
    assert not failed.truncations.any()


@pytest.mark.parametrize("kind", ["combined", "continuous"])
def test_other_actions_are_the_same_actions(
    kind: str, split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = exported(split, tmp_path / "out", monkeypatch, "--actions", kind, "--where", "level_id < 4")
    assert data.id == f"levelproof/128k/s-{kind}-v0"
    theirs = written(EVERY, ActionKind(kind))
    assert all(data.action_space.contains(action) for action in theirs)
    assert all(data.action_space.contains(action) for action in data[0].actions)
    if kind == "combined":
        np.testing.assert_array_equal(np.stack(np.unravel_index(theirs, CHOICES), -1), EVERY)
        assert data.action_space.n == len(EVERY)
    else:
        levels = levelproof.sample_levels(np.arange(len(EVERY)), levelproof.SIZES["s"], made_job().distribution)
        ours = controls(levels, jnp.asarray(EVERY.T))
        jax.tree.map(np.testing.assert_array_equal, ours, continuous_controls(levels, jnp.asarray(theirs.T)))


def test_what_cannot_be_is_refused(split: Path, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    command = ["export", str(split), "-o", str(tmp_path / "out"), "--format"]
    assert main([*command, "minari", "--where", "level_id < 0"]) == 2
    assert main([*command, "parquet", "--actions", "combined"]) == 2
    monkeypatch.setitem(sys.modules, "minari", None)
    assert main([*command, "minari"]) == 2
    nothing, actions, missing = capsys.readouterr().err.splitlines()
    assert "for which level_id < 0 holds has a witness" in nothing
    assert "--actions is for --format minari" in actions
    assert missing.endswith('run `pip install "minari[hdf5]"`.')
    assert not (tmp_path / "out").exists()
