"""Cloning of a policy from a small real split."""

import shutil
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from time import sleep
from typing import Any

import jax
import numpy as np
import pytest
from PIL import Image

import levelproof
from levelproof.configs.clone import CloneConfig
from levelproof.configs.convert import plain
from levelproof.configs.distill import DistillConfig
from levelproof.configs.train import TrainConfig
from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.evaluation import play, play_randomly, play_sampled
from levelproof.experts.imitation import ImitationConfig, compare, from_motion
from levelproof.experts.networks.over_levels import NetworkConfig, PolicyKind
from levelproof.experts.networks.saved import save_policy
from levelproof.experts.witness.witness import replay, steps_to_goal
from levelproof.levelgen.batching import take
from levelproof.levelgen.mirror import mirror
from levelproof.levelgen.task.actions import CHOICES
from levelproof.pipeline.learn import clone as module
from levelproof.pipeline.learn import distill, sealed
from levelproof.pipeline.learn import pool as pool_module
from levelproof.pipeline.learn.clone import COURSE
from levelproof.pipeline.learn.curves import draw_curves
from levelproof.pipeline.learn.pool import Feed, read_pool, validation_batches
from levelproof.pipeline.learn.sealed import SEALED_IDS
from levelproof.pipeline.learn.trained_on import levels_for
from levelproof.pipeline.store.locks import only_trainer
from tests.pace import patience
from tests.pipeline.command import assert_refused, here
from tests.pipeline.learn.runs import assert_guide_lists, metrics
from tests.pipeline.made import played_split
from tests.quick import jit_once

SETTINGS = (
    "interval=20",
    "played=0",
    "train.batch=128",
    "validation=0.3",
    "where=",
    "network.width=16",
    "network.depth=1",
)
UPDATES = "train.updates=200"  # static in the programs, so other numbers of updates compile them again


def cloned(folder: Path, split: Path, *words: str) -> Path:
    out = folder / "policy"
    done = here(["clone", str(split), "-o", str(out), *SETTINGS, *words], folder)
    assert done.returncode == 0, done.stderr
    return out


@pytest.fixture(scope="module")
def policy(split: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return cloned(tmp_path_factory.mktemp("cloned"), split, UPDATES, "where=label = 'solved'", "played=8")


def test_loss_falls(policy: Path) -> None:
    curve = metrics(policy)
    assert [numbers[COURSE.step] for numbers in curve] == list(range(20, 201, 20))
    assert curve[-1]["bc/loss"] < 0.6 * curve[0]["bc/loss"]
    assert curve[-1]["bc/accuracy"] > 0.75
    assert curve[-1]["bc/samples_per_second"] > 0


def test_validation_compares_the_saved_policy_with_validation_levels(policy: Path, split: Path) -> None:
    settings = replace(CloneConfig(), where="label = 'solved'", validation=0.3, train=ImitationConfig(200, batch=128))
    source, saved = module.source_of(split, settings, print), levelproof.load_policy(policy)
    held = validation_batches(source, settings)
    places = lambda level: {np.ascontiguousarray(x).tobytes() for x in np.moveaxis(level.model.vertices, -1, 0)}
    assert places(held[0].level) <= places(source.data.levels(source.validation))
    each = [compare(saved.params, batch, saved.network) for batch in held]
    (last,) = metrics(policy)[-1:]
    assert last["bc/validation_loss"] == pytest.approx(np.mean([x.loss for x in each]))
    assert last["bc/validation_accuracy"] == pytest.approx(np.mean([x.accuracy for x in each]))


def test_validation_levels_are_played(policy: Path, split: Path) -> None:
    names = ("eval/sampled_episode_solve_rate", "eval/sampled_episode_length")
    played = [[numbers[name] for name in names] for numbers in metrics(policy)]
    data = levelproof.open(split, where="label = 'solved'", validation=0.3)
    held = np.flatnonzero(module.in_subset(data.manifest["content_hash"].to_pylist(), "validation", 0.3))
    count = len(held)
    assert count <= 8, "all of them are played"
    for rate, length in played:
        assert 0 <= rate <= 1
        assert rate * count == pytest.approx(round(rate * count))
        assert 1 <= length <= RECORD_STEPS
    last, ids = levelproof.load_policy(policy), data.manifest["level_id"].to_numpy()[held]
    again = play(play_sampled(last.network), last.params, data.levels(held), ids, 1, CloneConfig().seed, data.rules)
    assert played[-1] == pytest.approx([again.solved.mean(), again.env_steps.mean()])


def test_curves_are_drawn_beside_the_policy(policy: Path, tmp_path: Path) -> None:
    with Image.open(policy / "curves.png") as picture:
        shown = {tuple(colour) for colour in np.asarray(picture.convert("RGB")).reshape(-1, 3).tolist()}
    assert {(62, 176, 92), (58, 124, 220)} <= shown, "a line of training and one of validation"
    draw_curves(metrics(policy), COURSE, tmp_path / "again.png")
    assert (tmp_path / "again.png").read_bytes() == (policy / "curves.png").read_bytes()


def test_curve_of_one_point_is_drawn(policy: Path, tmp_path: Path) -> None:
    draw_curves(metrics(policy)[:1], COURSE, tmp_path / "one.png")
    draw_curves([], COURSE, tmp_path / "none.png")
    assert (tmp_path / "one.png").read_bytes() != (tmp_path / "none.png").read_bytes()


def test_policy_beats_random_play_on_levels_it_was_trained_on(policy: Path, split: Path) -> None:
    data = levelproof.open(split, where="label = 'solved'", validation=0.3)
    trained = np.flatnonzero(module.in_subset(data.manifest["content_hash"].to_pylist(), "train", 0.3))
    levels, ids = data.levels(trained), data.manifest["level_id"].to_numpy()[trained]
    loaded = levelproof.load_policy(policy)
    share = lambda player, params: play(player, params, levels, ids, 8, 0, data.rules).solved.mean()
    assert share(play_sampled(loaded.network), loaded.params) > share(play_randomly, ()) + 0.05


@pytest.mark.campaign
def test_splits_of_several_sizes_make_one_policy(split: Path, tmp_path: Path) -> None:
    """The network is that of `policy`, so that only the programs of the larger size are compiled."""
    larger = played_split(tmp_path / "larger", held=8, size="m")
    out = cloned(tmp_path, split, str(larger), UPDATES, "episodes=all", "log=tensorboard")
    assert list((out / "log").glob("*/events*"))
    assert {f"bc/validation_loss/{path}" for path in (split, larger)} <= set(metrics(out)[-1])
    policy = levelproof.load_policy(out)
    for size in "sm":
        levels = levelproof.sample_levels(np.arange(2), size)
        assert jit_once(policy.logits)(levels, levels.state).shape == (sum(CHOICES), 2)
    done = here(["clone", str(split), str(larger), "network.kind=flat", "where="], tmp_path)
    assert_refused(done, 2, "levels of one size")


@pytest.mark.campaign
def test_wandb_keeps_the_curves_of_a_run(split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wandb = pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    out = cloned(tmp_path, split, UPDATES, "log=wandb")
    wandb.teardown()
    (kept,) = (out / "log").glob("wandb/offline-run-*/run-*.wandb")
    written = kept.read_bytes()
    names = {name for numbers in metrics(out) for name in numbers}
    assert {"bc/loss", "bc/validation_loss", "bc/core_seconds"} <= names
    assert [name for name in names if name.encode() not in written] == []


def test_levels_weigh_equally_and_end_at_their_first_goal(split: Path) -> None:
    """Levels are told apart by their polygons, which no two of them share."""
    config = replace(CloneConfig(), where="label = 'solved'", validation=0.3, train=ImitationConfig(100, batch=64))
    source = module.source_of(split, config, lambda _: None)
    pool = read_pool(source.data, source.train, config.network)
    ends = np.array([int(np.argmax(source.data[i].done)) + 1 for i in source.train.tolist()])
    np.testing.assert_array_equal(pool.steps, ends)
    assert len(pool.motion) == len(pool.action) == ends.sum()
    assert ends.max() > 1.5 * ends.min(), "levels of unequal length"
    level_of = {np.ascontiguousarray(pool.level.model.vertices[..., i]).tobytes(): i for i in range(len(ends))}
    assert len(level_of) == len(ends)
    drawn = np.zeros(len(ends), int)
    feed = Feed([source], config)
    for batch in feed.batches(0, feed.read(0)):
        for lane in range(config.train.batch):
            drawn[level_of[np.ascontiguousarray(batch.level.model.vertices[..., lane]).tobytes()]] += 1
    expected = drawn.sum() / len(ends)
    assert np.abs(drawn - expected).max() < 5 * expected**0.5


def test_note_has_the_levels_and_every_setting_that_decides_a_run(split: Path) -> None:
    first, second, *_ = levelproof.open(split).manifest["level_id"].to_pylist()
    without = lambda level_id: replace(CloneConfig(), where=f"level_id != {level_id}", validation=0.3)
    note, other = (
        module.note_of([module.source_of(split, config, print)], config) for config in map(without, (first, second))
    )
    assert note["splits"][0]["levels"] == other["splits"][0]["levels"]
    assert note["splits"][0]["ids"] != other["splits"][0]["ids"]
    assert plain(without(first)).keys() - note["settings"].keys() == {"log", "interval", "played"}


def test_levels_are_read_equally_often_if_memory_holds_two_thirds_of_them(split: Path) -> None:
    config = replace(CloneConfig(), where="", validation=0.3)
    source = module.source_of(split, config, lambda _: None)
    count = len(source.train) // 2 * 2
    source = source._replace(train=source.train[:count])
    (order,) = Feed([source], replace(config, pool=count * 2 // 3))._orders
    items, _ = order.items(range(2))
    assert sorted(items.tolist()) == list(range(count)), "each once in an epoch of two rounds"


@pytest.mark.parametrize(("updates", "share"), [(1, 0.5), (10, 0.5), (11, 1), (100, 1)])
def test_levels_that_no_update_draws_from_are_counted(split: Path, updates: int, share: float) -> None:
    config = replace(CloneConfig(), where="", validation=0.3, refresh=10, train=ImitationConfig(updates=updates))
    source = module.source_of(split, config, lambda _: None)
    count = len(source.train) // 2 * 2
    source = source._replace(train=source.train[:count])
    assert Feed([source], replace(config, pool=count // 2)).used == share * count
    assert Feed([source], config).used == count, "all are in memory"


def test_a_stopped_run_does_not_read_the_levels_of_the_next_pool(split: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = module.source_of(split, CloneConfig(), lambda _: None)
    config = CloneConfig(pool=len(source.train) // 2, refresh=4, train=ImitationConfig(9, batch=4))
    feed, begun, going_on, read = Feed([source], config), Event(), Event(), list[int]()
    pools, read_in_full = feed.read(0), source.data.read

    def slowly(some: np.ndarray, **how: Any) -> Any:
        begun.set()
        assert going_on.wait(patience(60))
        read.append(len(some))
        sleep(0.2)
        return read_in_full(some, **how)

    monkeypatch.setattr(pool_module, "AT_ONCE", 1)
    monkeypatch.setattr(pool_module, "own_cores", lambda: [0])
    monkeypatch.setattr(source.data, "read", slowly)
    batches = feed.batches(0, pools)
    next(batches)
    assert begun.wait(patience(60))
    closing = Thread(target=batches.close)
    closing.start()
    sleep(0.5)  # it waits for the read under way
    going_on.set()
    closing.join(patience(60))
    assert not closing.is_alive()
    assert len(read) < feed.levels, "not all of them"


def test_policy_that_no_run_has_made_is_not_overwritten(split: Path, tmp_path: Path) -> None:
    save_policy(tmp_path / "policy", levelproof.load_policy("builtin:s"))
    files = {path: path.read_bytes() for path in (tmp_path / "policy").iterdir()}
    done = here(["clone", str(split), "-o", "policy"], tmp_path)
    assert_refused(done, 2, "policy has a policy already: choose another folder with -o.")
    assert {path: path.read_bytes() for path in files} == files


def test_bad_input_is_refused(split: Path, policy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert_refused(here(["clone", "train.updates=3"], tmp_path), 2, "No split was given")
    assert_refused(here(["clone", str(split), "train.update=3"], tmp_path), 2, "did you mean train.updates?")
    assert_refused(here(["clone", str(split), "network.width=6"], tmp_path), 2, "multiple of heads")
    assert_refused(here(["clone", str(split), "-o", str(policy)], tmp_path), 2, "other settings or levels")
    assert_refused(here(["clone", str(tmp_path / "none")], tmp_path), 2, "none")
    with pytest.raises(levelproof.PolicyError, match="There is no policy in"):
        levelproof.load_policy(tmp_path)
    (tmp_path / "file").touch()
    assert_refused(here(["clone", str(split), "-o", "file"], tmp_path), 2, "Cannot write a policy to file")
    first = int(levelproof.open(split).manifest["level_id"][0].as_py())
    monkeypatch.setattr(sealed, "SEALED_IDS", range(first, first + 2))
    with pytest.raises(levelproof.UserError, match="sealed"):
        module.source_of(split, CloneConfig(where=""), print)


def test_transformer_learns_from_states_with_their_contacts(split: Path) -> None:
    config = CloneConfig(where="", network=NetworkConfig(PolicyKind.TRANSFORMER))
    data = module.source_of(split, config, print).data
    pool = read_pool(data, np.arange(2), config.network, config.episodes == "all", config.mirror)
    state = from_motion(pool.motion[pool.first[1] :], data.size)
    stored = data.read([1], fields=["record/state"], observation=None).fields
    steps = int(pool.steps[1])
    contacts = stored["record/state/contact_active"][0, :steps]
    assert contacts.any()
    np.testing.assert_array_equal(np.asarray(state.contact_active).T, contacts)
    np.testing.assert_array_equal(
        np.moveaxis(np.asarray(state.position), -1, 0), stored["record/state/position"][0, :steps]
    )


@pytest.mark.slow
def test_pool_has_the_mirror_images_that_solve(split: Path) -> None:
    config = CloneConfig(where="label = 'solved'", mirror=True)
    data = module.source_of(split, replace(config, validation=0.3), print).data
    plain_pool, pool = (read_pool(data, np.arange(len(data)), config.network, mirror=each) for each in (False, True))
    count = len(plain_pool.steps)
    assert 1.5 * count < len(pool.steps) <= 2 * count
    assert len(pool.level) == len(pool.steps)
    for name in ("motion", "action"):
        np.testing.assert_array_equal(getattr(pool, name)[: len(plain_pool.motion)], getattr(plain_pool, name))
    steps, first = pool.steps[count:], pool.first[count:]
    images = jax.tree.map(np.asarray, mirror(data.levels(np.arange(len(data)))))
    starts = np.asarray(from_motion(pool.motion[first], data.size).position)
    same = (images.state.position[..., None] == starts[:, :, None]).all((0, 1))  # image, lane
    np.testing.assert_array_equal(same.sum(0), 1)
    images = take(images, same.argmax(0))
    jax.tree.map(
        np.testing.assert_array_equal,
        take(pool.level, np.arange(count, len(pool.steps))),
        replace(images, state=None),  # pyright: ignore
    )
    row = first + np.minimum(np.arange(RECORD_STEPS)[:, None], steps - 1)
    record = replay(images, np.moveaxis(pool.action[row], -1, 1), data.rules)
    np.testing.assert_array_equal(steps_to_goal(record.done), steps)
    for lane in range(len(steps)):
        assert record.goal[steps[lane] - 1, lane]
        states = from_motion(pool.motion[first[lane] :][: steps[lane]], data.size)
        np.testing.assert_array_equal(
            np.moveaxis(np.asarray(states.position), -1, 0), record.state.position[: steps[lane], ..., lane]
        )


def test_pool_may_have_no_mirror_image(split: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mirrored = pool_module.mirrored
    nothing = lambda *arguments: jax.tree.map(lambda x: x[:0], mirrored(*arguments))
    monkeypatch.setattr(pool_module, "mirrored", nothing)
    config = CloneConfig(where="label = 'solved'")
    data = module.source_of(split, replace(config, validation=0.3), print).data
    plain_pool, pool = (read_pool(data, np.arange(4), config.network, mirror=each) for each in (False, True))
    jax.tree.map(np.testing.assert_array_equal, pool, plain_pool)


def test_second_clone_is_refused_where_one_runs(split: Path, tmp_path: Path) -> None:
    (tmp_path / "policy").mkdir()
    with only_trainer(tmp_path / "policy"):
        assert_refused(here(["clone", str(split), "where="], tmp_path), 2, "Another command is writing")
    assert not (tmp_path / "policy" / "run.json").exists()


def test_clone_writes_nothing_to_a_recreated_folder(
    split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, validated = tmp_path / "policy", module.validated

    def made_again(*arguments: Any) -> dict[str, float]:
        shutil.rmtree(out)
        out.mkdir()
        return validated(*arguments)

    monkeypatch.setattr(module, "validated", made_again)
    done = here(["clone", str(split), *SETTINGS, UPDATES], tmp_path)
    assert_refused(done, 1, "policy was removed or recreated")
    assert not list(out.iterdir())


def test_copies_of_sealed_levels_are_left_out(tmp_path: Path) -> None:
    copies, messages = played_split(tmp_path / "copies", copies=SEALED_IDS[-16:]), []
    source = module.source_of(copies, CloneConfig(where="", validation=0.5), messages.append)
    others = np.flatnonzero(source.data.manifest["level_id"].to_numpy() >= 16)
    assert 1 < source.copies == len(source.data) - len(others)
    assert sorted([*source.train, *source.validation]) == others.tolist()
    assert messages == [
        f"Left out {source.copies} levels of {copies}: copies of sealed levels, kept to measure policies."
    ]
    ids = source.data.manifest["level_id"].to_numpy()
    for starts in (1, 2):
        trained = levels_for(TrainConfig(levels=str(copies), where="label = 'solved'", starts=starts), print)
        assert len(trained.levels) == starts * len(others)
        np.testing.assert_array_equal(
            trained.levels.model.vertices[..., : len(others)], source.data.levels(others).model.vertices
        )
    distilled = distill.levels_for(copies, DistillConfig(where=""), print)
    np.testing.assert_array_equal(distilled.data.manifest["level_id"].to_numpy()[distilled.chosen], ids[others])


def test_guide_lists_every_setting_with_its_default_and_meaning() -> None:
    assert_guide_lists({"": CloneConfig(), "network.": NetworkConfig(), "train.": ImitationConfig()}, "train")
