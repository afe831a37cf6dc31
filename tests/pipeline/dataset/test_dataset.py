"""`Dataset`: trajectories equal to those in shards, and states to start the environment from."""

import pickle
import shutil
from pathlib import Path

import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import levelproof
from levelproof.levelgen.task.actions import action_mask
from levelproof.levelgen.task.environment import make
from levelproof.levelgen.task.observe.kinds import ObservationType
from levelproof.pipeline.dataset import observations
from levelproof.pipeline.dataset.batch import timed_out
from levelproof.pipeline.dataset.dataset import Dataset, open
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.read.rows import read_rows
from levelproof.pipeline.store.fields import arrays_of, same_bits
from levelproof.pipeline.store.manifest import read_manifest
from tests.trees import assert_same, lanes_last

STEPS = 48


def test_manifest_has_the_levels_with_a_witness(split: Path, data: Dataset) -> None:
    table = read_manifest(split).table
    with_witness = [row["level_id"] for row in table.to_pylist() if row["shard"]]
    assert data.manifest["level_id"].to_pylist() == with_witness
    assert len(data) == len(with_witness)
    some = open(split, "level_id < 20", columns=["device"])
    assert some.manifest["level_id"].to_pylist() == [i for i in with_witness if i < 20]
    assert "device" in some.manifest.column_names


def test_getitem_returns_what_the_shard_stores(split: Path, data: Dataset) -> None:
    one, stored = data[2], read_rows(split, data.manifest.slice(2, 1))
    for name, values in stored.items():
        assert same_bits(one.fields[name][..., None], values).all(), name
    assert one.level_id == data.manifest["level_id"][2].as_py()
    assert one.record.state.position.shape == (256, 7, 2)
    assert one.level.role.shape == (7,)
    assert_same(one.action, stored["record/action"][..., 0])
    assert_same(data[-1].level_id, data[len(data) - 1].level_id)
    with pytest.raises(IndexError, match="There is no trajectory"):
        data[len(data)]


def test_read_returns_arrays_with_the_batch_axis_first(data: Dataset) -> None:
    batch = data.read([3, 0, 3], fields=["record/state", "level"], observation=None)
    assert batch.observation is None
    assert batch.state.position.shape == (3, 256, 7, 2)
    assert batch.action.shape == batch.action_mask.shape == (3, 256, 6)
    assert batch.reward.shape == batch.done.shape == batch.goal.shape == batch.mask.shape == (3, 256)
    assert_same(batch.action_mask[:, 7].T, action_mask(lanes_last(batch.level)))
    assert_same(batch.state.rotation[1], data[0].state.rotation)
    with pytest.raises(UserError, match=r"The field record/manifold/active was not read: pass fields=\['record'\]"):
        batch.record  # noqa: B018


def test_read_tells_terminated_from_truncated(data: Dataset) -> None:
    every = np.arange(len(data))
    batch = data.read(every, fields=["record/timestep"], observation=None)
    late = batch.fields["record/timestep"] + 1 >= data.rules.max_timesteps
    assert_same(batch.truncated, batch.done & ~batch.goal & late)
    assert_same(batch.terminated, batch.done & ~batch.truncated)
    assert batch.terminated.any()
    assert not (batch.goal & ~batch.terminated).any()
    window = data.read(every, length=56, first=200, observation=None)
    assert_same(window.truncated, batch.truncated[:, 200:])


def test_timed_out_marks_episodes_as_long_as_the_limit() -> None:
    done, goal = np.zeros((3, 12), bool), np.zeros((3, 12), bool)
    done[0, [3, 7, 10]] = done[1, [1, 5, 11]] = done[2, [3]] = goal[2, 3] = True
    expected = np.zeros((3, 12), bool)
    expected[0, [3, 7]] = expected[1, [5, 11]] = True
    assert_same(timed_out(done, goal, 4), expected)


def test_read_cuts_windows_from_trajectories(data: Dataset) -> None:
    cut = data.read([3, 1], length=10, first=[250, 4], fields=["record/state"], observation=None)
    whole = data.read([3, 1], fields=["record/state"], observation=None)
    assert_same(cut.state.position[0, :6], whole.state.position[0, 250:])
    assert_same(cut.state.position[1], whole.state.position[1, 4:14])
    assert cut.mask.sum(1).tolist() == [6, 10]
    late = data.read([3], first=200, fields=["record/state"], observation=None)
    assert_same(late.state.position[0, :56], whole.state.position[0, 200:])
    assert late.mask.sum() == 56
    assert_same(data.read(3, first=200, fields=["record/state"], observation=None).fields, late.fields)


def test_batches_of_similar_sizes_share_a_program_of_observations(data: Dataset) -> None:
    indices = np.arange(32) % len(data)
    shown = data.read(indices, length=3).observation
    programs = observations._observe._cache_size()
    np.testing.assert_array_equal(data.read(indices[:31], length=3).observation, shown[:31])
    assert observations._observe._cache_size() == programs


def test_getitem_observation_equals_the_environments(data: Dataset) -> None:
    shown = jax.jit(make(data.levels([2]))[0].get_obs)(data.state(2, 30))
    np.testing.assert_allclose(data[2].observation[30], shown, rtol=1e-6, atol=1e-6)


@pytest.mark.campaign
@pytest.mark.parametrize("kind", list(ObservationType))
def test_read_observations_of_all_types_equal_the_environments(data: Dataset, kind: str) -> None:
    env, _ = make(data.levels([0, 2]), observation_type=kind)
    observation = data.read([0, 2], length=3, first=[9, 30], observation=kind).observation
    for step in range(3):
        shown = jax.vmap(env.get_obs)(data.state([0, 2], [9 + step, 30 + step]))
        jax.tree.map(
            lambda x, y, step=step: np.testing.assert_allclose(x[:, step], y, rtol=1e-6, atol=1e-6), observation, shown
        )


def test_playing_on_from_a_stored_state_reproduces_the_stored_steps(data: Dataset) -> None:
    """Bit for bit, through the environment, across ends of episodes and resets."""
    indices, steps = np.array([0, 1, 2, 3]), np.array([0, 10, 100, 200])
    batch = data.read(indices, fields=["record", "level"], observation=None)
    assert (batch.done[:, :STEPS] | batch.done[:, 100 : 100 + STEPS]).any(), (
        "no episode ends on the way: choose other trajectories"
    )
    env, params = levelproof.make(data.levels(indices), rules=data.rules)
    starts = data.state(indices)
    actions = np.stack([batch.action[i, t : t + STEPS] for i, t in zip(indices, steps, strict=True)], 1)

    def play(state, action):
        keys = jax.random.split(jax.random.key(0), len(indices))
        _, after, reward, done, info = jax.vmap(env.step, (0, 0, 0, None, 0))(keys, state, action, params, starts)
        return after, (state, reward, done, info["GoalR"])

    states, reward, done, goal = jax.jit(lambda: jax.lax.scan(play, data.state(indices, steps), actions))()[1]
    stored = arrays_of(batch.record.state)
    for lane, (i, first) in enumerate(zip(indices, steps, strict=True)):
        for name, values in arrays_of(states.now.state).items():
            assert same_bits(values[:, lane].T, stored[name][i, first : first + STEPS].T).all(), name
        assert_same(states.timestep[:, lane], batch.record.timestep[i, first : first + STEPS])
        assert_same(reward[:, lane], batch.reward[i, first : first + STEPS])
        assert_same(done[:, lane], batch.done[i, first : first + STEPS])
        assert_same(goal[:, lane], batch.goal[i, first : first + STEPS])


def test_state_of_one_index_has_no_leading_axis(data: Dataset) -> None:
    assert_same(data.state(3, 20), jax.tree.map(lambda x: np.asarray(x)[1], data.state([1, 3], 20)))


def test_read_follows_levels_moved_by_a_seal(split: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(split, tmp_path / "s"))
    data = open(copy)
    before = data.read([0, 1], observation=None)
    (fragment,) = (copy / "manifest").glob("*.parquet")
    old, new = data.manifest["shard"][0].as_py(), "shards/000000000000-000000000063-ffffffff.zarr"
    shutil.move(copy / old, copy / new)
    table = pq.read_table(fragment)
    at = table.schema.get_field_index("shard")
    names = [new if name else None for name in table["shard"].to_pylist()]
    pq.write_table(table.set_column(at, table.schema.field(at), pa.array(names)), fragment)
    assert_same(data.read([0, 1], observation=None), before)
    assert set(data.manifest["shard"].to_pylist()) == {new}


def test_batches_report_a_damaged_shard_and_end(split: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(split, tmp_path / "s"))
    data = open(copy)
    file = next((copy / "shards").rglob("dyn32/c/0/0/0"))
    content = bytearray(file.read_bytes())
    content[100] ^= 1
    file.write_bytes(content)
    batches = data.batches(64, observation=None)
    with pytest.raises(Failure, match=r"^The shard .* is missing or damaged \(.*\): .*$"):
        next(batches)
    with pytest.raises(StopIteration):
        next(batches)


def test_pickle_is_small_and_rejects_a_changed_split(split: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(split, tmp_path / "s"))
    pickled = pickle.dumps(open(copy, "level_id < 50"))
    assert len(pickled) < 1000
    assert len(pickle.loads(pickled)) == len(open(copy, "level_id < 50"))
    (fragment,) = (copy / "manifest").glob("*.parquet")
    table = pq.read_table(fragment)
    pq.write_table(table.slice(1).replace_schema_metadata(table.schema.metadata), fragment)
    with pytest.raises(Failure, match="no longer has the trajectories that it had"):
        pickle.loads(pickled)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"fields": ["record/stat"]}, "There is no field 'record/stat' \\(did you mean record/state\\?\\)"),
        ({"fields": ["xyzzy"]}, "There is no field 'xyzzy'"),
        ({"observation": "flat"}, "There is no observation 'flat': choose one of symbolic_flat, "),
        ({"length": 300}, "A window cannot have 300 steps"),
        ({"subset": "test"}, "There is no subset 'test'"),
    ],
)
def test_batches_and_grain_reject_invalid_arguments(data: Dataset, arguments: dict, sentence: str) -> None:
    with pytest.raises(UserError, match=sentence):
        data.batches(8, **arguments)
    with pytest.raises(UserError, match=sentence):
        data.grain(**arguments)


def test_open_read_and_state_reject_invalid_arguments(split: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="There is no split at"):
        open(tmp_path / "nothing")
    with pytest.raises(UserError, match="has no trajectories for which level_id < 0 holds: `levelproof inspect"):
        open(split, "level_id < 0")
    with pytest.raises(UserError, match=r"Cannot use the condition .*lable"):
        open(split, "lable = 'solved'")
    with pytest.raises(UserError, match="There is no column 'lable'"):
        open(split, columns=["lable"])
    with pytest.raises(UserError, match="The share of validation is 2"):
        open(split, validation=2)
    with pytest.raises(UserError, match="trajectories is in the subset validation: pass another validation= to open"):
        open(split, validation=0).batches(8, subset="validation")
    for indices, sentence in (
        ([0, 999], "no trajectory 999:"),
        ([-1, 0], "no trajectory -1:"),
        ([], "at least one index"),
    ):
        with pytest.raises(UserError, match=sentence):
            open(split).read(indices)
    for read in open(split).read, open(split).levels, open(split).episodes:
        with pytest.raises(UserError, match=r"The indices have the shape \[1, 2\]: they must have one axis"):
            read([[0, 1]])
    with pytest.raises(UserError, match=r"first steps have the shape \[2\]: they must have the shape \[3\]"):
        open(split).read([0, 1, 0], first=[0, 1])
    for step in (256, -1):
        with pytest.raises(UserError, match=f"There are no steps {step} in a record"):
            open(split).state(0, step)
        with pytest.raises(UserError, match=rf"There are no steps \[{step}\] in a record"):
            open(split).read([0], first=step)


@pytest.mark.parametrize("read", ["read", "levels", "episodes", "state"])
def test_masks_and_fractions_are_not_indices(data: Dataset, read: str) -> None:
    """They would read the trajectories 0 and 1 again and again."""
    with pytest.raises(UserError, match=r"must be integers, not of the type bool: pass np\.flatnonzero\(mask\)"):
        getattr(data, read)(np.arange(len(data)) % 2 == 0)
    with pytest.raises(UserError, match="The indices must be integers, not of the type float64: convert them"):
        getattr(data, read)([0.5, 1.0])
