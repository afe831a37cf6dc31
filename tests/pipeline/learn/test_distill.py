"""Distilling a policy from teachers on a small real split, and continuing to the same bytes."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest
from rich.console import Console
from safetensors.numpy import load_file

import levelproof
from levelproof.configs.compose import compose_distill
from levelproof.configs.convert import plain
from levelproof.configs.distill import DistillConfig
from levelproof.experts.generalist.teachers import KnownExperts, Labels
from levelproof.experts.labels import Label
from levelproof.experts.networks.over_levels import NetworkConfig
from levelproof.experts.verdict.judge import KeptExpert
from levelproof.pipeline.learn import distill as module
from levelproof.pipeline.learn import kept_experts, rounds, sealed
from levelproof.pipeline.learn.kept_experts import experts_of
from levelproof.pipeline.learn.labelled import empty_labels, with_labels
from levelproof.pipeline.learn.pool import LevelPool
from levelproof.pipeline.store.checkpoints import begun_like, save_experts
from levelproof.pipeline.store.layout import EXPERTS
from tests.pipeline.command import assert_refused, here
from tests.pipeline.learn.runs import assert_average_is_kept, assert_guide_lists, metrics, stop_in_first_update
from tests.pipeline.made import honest_split, made_job

TINY = ("network.width=8", "network.depth=1", "network.heads=1")
ROUNDS = ("train.updates=6", "interval=2", "train.batch=32", "episodes=8", "states=16", "buffer=256")
TEACHERS = ("teachers.witness=2", "teachers.random=8", "teachers.learner=1")


def distilled(folder: Path, split: Path, *words: str, teachers: tuple[str, ...] = TEACHERS) -> Path:
    folder.mkdir(exist_ok=True)
    done = here(["distill", str(split), "-o", "policy", *ROUNDS, *teachers, *words], folder)
    assert done.returncode == 0, done.stderr
    return folder / "policy"


@pytest.fixture(scope="module")
def policy(split: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return distilled(tmp_path_factory.mktemp("distilled"), split, *TINY)


@pytest.mark.slow
def test_every_state_has_a_teacher_or_none(policy: Path) -> None:
    curve = metrics(policy)
    assert [line["distill/updates"] for line in curve] == [2, 4, 6]
    for line in curve:
        by = [line[f"distill/by_{name}"] for name in ("expert", "witness", "random", "learner")]
        assert sum(by) + line["distill/none"] == line["distill/asked"] == 16
        assert by[0] == 0, "the split kept no experts"
        assert line["distill/env_steps"] > 0
    assert sum(line["distill/labelled"] for line in curve) > 0


@pytest.mark.slow
def test_kept_experts_of_a_split_label_states_and_demonstrate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = ["generate", "levels=16", "budget=5k", "keep_experts=true", "executor=inline"]
    assert here(job, tmp_path).returncode == 0
    shown = "demonstrations=8", "path=4"
    out = distilled(tmp_path, tmp_path / "data/5k/s", *TINY, "teachers.expert=4", *shown)
    assert sum(line["distill/by_expert"] for line in metrics(out)) > 0
    added = load_file(out / "checkpoint.safetensors")[".labels.added"]
    out.rename(tmp_path / "both")
    split, alone = tmp_path / "data/5k/s", ("states=0", *TINY, *shown)
    with monkeypatch.context() as patch:
        stop_in_first_update(patch)
        assert here(["distill", str(split), "-o", "policy", *ROUNDS, *alone], tmp_path).returncode == 130
    assert load_file(tmp_path / "policy/checkpoint.safetensors")[".imitation.updates"] == 2
    out = distilled(tmp_path, split, *alone, teachers=())
    weights = (out / "policy.safetensors").read_bytes()
    for line in metrics(out):
        assert line["distill/asked"] == line["distill/none"] == 0
        assert line["distill/demonstrations"] == 8
        assert 0 < line["distill/demonstrated"] <= 1
    assert 0 < load_file(out / "checkpoint.safetensors")[".labels.added"] < added
    out.rename(tmp_path / "stopped")
    again = distilled(tmp_path, split, *alone, teachers=())
    assert (again / "policy.safetensors").read_bytes() == weights


def test_levels_without_an_expert_are_not_demonstrated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every round takes other levels, each shown by its own expert."""
    experts, seen = np.where(np.arange(600) % 2, np.arange(600) // 2, -1), []

    def demonstrations(levels: Any, known: KnownExperts, *_: Any) -> Labels:
        seen.append((levels, known.expert))
        return labels_of([3] * len(known.expert))

    monkeypatch.setattr(rounds, "demonstrations", demonstrations)
    known = KnownExperts(None, None, experts)
    taught = SimpleNamespace(levels=np.arange(600), experts=known, rules=None)
    config, network = DistillConfig(demonstrations=270), NetworkConfig()
    shown = [list(rounds.shown_by_experts(taught, config, network, jax.random.key(0), i)) for i in (0, 1)]  # pyright: ignore
    assert [[len(each.level) for each in one] for one in shown] == [[256, 14]] * 2
    for one in shown:
        levels = np.concatenate([each.level for each in one])
        assert len(set(levels.tolist())) == 270
        assert (levels % 2 == 1).all()
    assert (shown[0][0].level != shown[1][0].level).any()
    for levels, expert in seen:
        np.testing.assert_array_equal(experts[levels], expert)


@pytest.mark.slow
def test_folder_holds_a_policy_with_its_origin(policy: Path, split: Path) -> None:
    loaded = levelproof.load_policy(policy)
    assert loaded.size is None
    assert loaded.origin["updates"] == 6
    assert loaded.origin["splits"][0]["split"] == str(split)
    assert (policy / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert_average_is_kept(policy, ".imitation.average", ".imitation.params")


@pytest.mark.slow
def test_start_gives_weights_and_network(
    policy: Path, split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "update_until_done", lambda taught, config, network, now, *_: now)
    out = distilled(tmp_path, split, f"start={policy}")
    before, after = ((folder / "policy.safetensors").read_bytes() for folder in (policy, out))
    assert before == after
    assert levelproof.load_policy(out).origin["start_origin"] == levelproof.load_policy(policy).origin


def labels_of(lengths: list[int], columns: int = 2) -> Labels:
    """Return labels whose motion and actions say which state and env step they are of."""
    steps, states = np.meshgrid(np.arange(256), np.arange(len(lengths)), indexing="ij")
    action = np.repeat(steps[:, None] % 100, 6, 1).astype(np.int8)
    motion = np.resize(np.stack([steps, states], -1), (*steps.shape, columns)).astype(np.float32)
    return Labels(np.array(lengths) > 0, np.array(lengths), action, motion, 0)


def test_buffer_keeps_the_latest_transitions_and_none_without_a_label() -> None:
    level = np.array([7, 8, 9])
    buffer = with_labels(empty_labels(8, 2), level, labels_of([50, 0, 2]), 3)
    assert buffer.filled == 5
    assert buffer.level[:5].tolist() == [7, 7, 7, 9, 9]
    assert buffer.motion[:5, 0].tolist() == [0, 24, 49, 0, 1]
    assert buffer.action[:5, 0].tolist() == [0, 24, 49, 0, 1]
    later = with_labels(buffer, level, labels_of([0, 90, 1]), 3)
    assert later.filled == 8
    assert later.level.tolist() == [9, 7, 7, 9, 9, 8, 8, 8]
    assert with_labels(later, level, labels_of([0, 0, 0]), 3).added == later.added
    alone = with_labels(empty_labels(8, 2), level, labels_of([50, 3, 2]), 1)
    assert alone.motion[:3].tolist() == [[0, 0], [0, 1], [0, 2]]
    assert with_labels(empty_labels(2, 2), level, labels_of([50, 3, 2]), 3).level.tolist() == [9, 9]


def test_batches_mix_transitions_of_witnesses_and_of_teachers() -> None:
    """A quarter of each is from witnesses, all if there are no labels; motion and actions say whose they are."""
    steps = np.array([3, 1, 4, 2, 6])
    rows, of_level = 1 + np.arange(steps.sum()), np.repeat(np.arange(len(steps)), steps)
    six = lambda x: np.repeat(x[:, None], 6, 1).astype(np.int8)
    index: Any = np.arange(len(steps))  # stands for the levels
    pool = LevelPool(index, np.cumsum(steps) - steps, steps, np.stack([of_level, rows], 1), six(rows))
    taught: Any = SimpleNamespace(level_ids=index, witnesses=pool)
    taken, later = np.array([4, 0, 2, 2, 3, 1]), 100 + np.arange(6)
    labels = empty_labels(8, 2)._replace(added=np.array(6, np.int32))
    labels.level[:6], labels.motion[:6], labels.action[:6] = taken, np.stack([taken, later], 1), six(later)

    config = DistillConfig(witnesses=0.25, train=replace(DistillConfig().train, batch=64))
    several = list(module.batches(taught, labels, config, range(20)))
    (alone,) = module.batches(taught, empty_labels(8, 2), config, range(1))
    for batch, witnessed in [*((each, 16) for each in several), (alone, 64)]:
        np.testing.assert_array_equal(batch.level, batch.motion[:, 0])
        np.testing.assert_array_equal(batch.action.T, [batch.motion[:, 1]] * 6)
        assert np.isin(batch.motion[:, 1], rows).sum() == witnessed
        assert batch.motion.shape == (64, 2)
    assert set(np.concatenate([each.motion[:, 1] for each in several])) == {*rows, *later}
    (again,) = module.batches(taught, labels, config, range(2, 3))
    np.testing.assert_array_equal(again.motion, several[2].motion)


@pytest.mark.slow
def test_run_without_any_label_says_so(split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rounds, "label_states", lambda asked, *_: labels_of([0] * 16, 6 * asked.level.size.bodies))
    done = here(["distill", str(split), "-o", "policy", *ROUNDS, *TINY, "witnesses=0"], tmp_path)
    assert_refused(done, 2, "No teacher reached the goal: set witnesses above 0")


@pytest.mark.slow
def test_experts_that_a_split_kept_are_those_of_their_levels(
    split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, ids = made_job("data", "size=s"), np.arange(5)
    name = f"{EXPERTS}/000000000000-000000000004-0123456789abcdef.npz"
    marked = lambda i: jax.tree.map(lambda x: np.full_like(x, i), begun_like(job))
    save_experts(tmp_path / "experts.npz", {i: KeptExpert(marked(i), [0.5]) for i in (1, 3)})
    rows = [{"level_id": i, "size": "s", "experts": name if i in (1, 3) else None} for i in ids.tolist()]
    manifest = kept_experts.require_manifest(split, ["experts", "size"], ids)
    table = manifest.table.from_pylist(rows)
    monkeypatch.setattr(
        kept_experts, "require_manifest", lambda *_: SimpleNamespace(table=table, config=manifest.config)
    )
    monkeypatch.setattr(kept_experts, "data_path", lambda *_: tmp_path / "experts.npz")
    known = experts_of(split, ids, print)
    assert known.config == job.expert
    assert (known.expert >= 0).tolist() == [False, True, False, True, False]
    leaf = jax.tree.leaves(known.params)[0]
    assert [np.unique(leaf[known.expert[i]]).tolist() for i in (1, 3)] == [[1], [3]]
    (tmp_path / "experts.npz").write_bytes(b"")
    with pytest.raises(levelproof.Failure, match=r"cannot be read .*: set teachers.expert=0"):
        experts_of(split, ids, print)
    told = list[str]()
    monkeypatch.setattr(kept_experts, "is_remote", lambda _: True)
    assert experts_of(split, ids, told.append).config is None
    assert told == [f"The experts kept in {split} are not used: copy the split to this machine to use them."]


def test_experts_whose_updates_need_a_larger_budget_are_read(
    split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, ids = made_job("data", "size=s", "budget=1M", "expert.environments=8192"), np.arange(1)
    save_experts(tmp_path / "experts.npz", {0: KeptExpert(begun_like(job), [0.5])})
    table = kept_experts.require_manifest(split, ["experts", "size"], ids).table.from_pylist(
        [{"level_id": 0, "size": "s", "experts": f"{EXPERTS}/000000000000-000000000000-0123456789abcdef.npz"}]
    )
    monkeypatch.setattr(kept_experts, "require_manifest", lambda *_: SimpleNamespace(table=table, config=job.results))
    monkeypatch.setattr(kept_experts, "data_path", lambda *_: tmp_path / "experts.npz")
    assert experts_of(split, ids, print).config == job.expert


def test_levels_are_witnessed_and_neither_trivial_nor_sealed(split: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config, quiet = DistillConfig(), Console(quiet=True)
    chosen = module.levels_for(split, config, print)
    taught = module.witnessed(chosen, NetworkConfig(), quiet)
    data = levelproof.open(split, where="label = 'solved'")
    ids = data.manifest["level_id"].to_numpy()
    assert np.array_equal(taught.level_ids, ids)
    witness = taught.witness_of(np.arange(3))
    stored = data.read(np.arange(3), observation=None)
    for i in range(3):
        first = int(np.argmax(stored.done[i])) + 1
        assert np.array_equal(witness[:first, :, i], stored.action[i, :first])
        assert (witness[first:, :, i] == stored.action[i, first - 1]).all()
    told: list[str] = []
    some = module.levels_for(split, DistillConfig(pool=3), told.append)
    assert told == [f"Only 3 of {len(ids):,} levels of {split} are used, drawn once: raise pool for more."]
    few = module.witnessed(some, NetworkConfig(), quiet)
    assert len(few.level_ids) == len(few.levels) == len(few.witnesses.steps) == 3
    monkeypatch.setattr(sealed, "SEALED_IDS", range(int(ids[0]), int(ids[0]) + 1))
    with pytest.raises(levelproof.UserError, match="sealed to measure policies"):
        module.levels_for(split, config, print)


def test_note_has_the_levels_and_every_setting_that_decides_a_run(split: Path) -> None:
    first, second, *_ = levelproof.open(split).manifest["level_id"].to_pylist()
    start = lambda level_id, policy: DistillConfig(where=f"level_id != {level_id}", start=policy)
    notes = [
        module.note_of(module.levels_for(split, config, print), config)
        for config in (start(first, "builtin:s"), start(second, "builtin:s"), start(first, "builtin:m"))
    ]
    ids, starts = [note["splits"][0]["ids"] for note in notes], [note["start"] for note in notes]
    assert ids[0] == ids[2] != ids[1]
    assert starts[0] == starts[1] != starts[2]
    assert plain(DistillConfig()).keys() - notes[0]["settings"].keys() == {"log"}


def test_trivial_levels_are_left_out(tmp_path: Path) -> None:
    split = honest_split(tmp_path, 16, 2)
    data = levelproof.open(split)
    labels = np.array(data.manifest["label"].to_pylist())
    chosen = module.levels_for(split, DistillConfig(where=""), print)
    np.testing.assert_array_equal(chosen.chosen, np.flatnonzero(labels != Label.TRIVIAL))
    assert 0 < len(chosen.chosen) < len(data)
    with pytest.raises(levelproof.UserError, match="meet the condition are trivial"):
        module.levels_for(split, DistillConfig(where="label = 'trivial'"), print)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([], "Distilling takes the levels of one split: name one, as in"),
        (["one", "two"], "name one, not 2"),
        (["none"], "none"),
        (["SPLIT", "stats=3"], "did you mean states?"),
        (["SPLIT", "start=none"], "There is no policy in none"),
        (
            ["SPLIT", "start=policy", "network.width=8"],
            "network.width cannot change the network",
        ),
        (["SPLIT", "witnesses=1"], "witnesses is 1"),
        (["SPLIT", "buffer=4095"], "up to 4,096 transitions, 16 of each of 256 labels"),
        (["SPLIT", "states=0"], "states and demonstrations are both 0"),
        (["SPLIT", "demonstrations=4"], "no kept experts of these levels, and demonstrations need them"),
        (["SPLIT", "teachers.perturbed=1"], "teachers.perturbed has no effect without demonstrations"),
        (["SPLIT", "states=0", "demonstrations=4", "failed=1"], "failed has no effect with states=0"),
        (["SPLIT", "demonstrations=4", "teachers.sticky=2"], "teachers.sticky is 2"),
        (["SPLIT", "failed=2"], "failed is 2"),
        (["SPLIT", "teachers.witness=0", "teachers.random=0", "teachers.learner=0"], "no other teacher is asked"),
        (["SPLIT", "teachers.random=-1"], "teachers.random is -1"),
        (["SPLIT", "where=level_id < 0"], "has no trajectories for which level_id < 0"),
        (["SPLIT", "-o", "file"], "Cannot write a policy to file"),
    ],
)
def test_bad_input_is_refused_in_one_sentence(words: list[str], sentence: str, split: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    words = [str(split) if word == "SPLIT" else word for word in words]
    assert_refused(here(["distill", *(words or ["states=4"])], tmp_path), 2, sentence)
    assert not (tmp_path / "distilled").exists()


@pytest.mark.slow
def test_folder_of_another_run_is_refused_before_levels_are_read(
    policy: Path, split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(policy, tmp_path / "policy")
    monkeypatch.delattr(module, "read_pool")
    done = here(["distill", str(split), "-o", "policy", *ROUNDS, *TEACHERS, *TINY, "seed=1"], tmp_path)
    assert_refused(done, 2, "has a run with other settings or levels")


def test_a_changed_setting_keeps_the_other_defaults_of_its_group() -> None:
    """The defaults of `train` are not those of cloning."""
    train = compose_distill(["train.updates=3"]).train
    assert (train.updates, train.learning_rate) == (3, DistillConfig().train.learning_rate)


def test_guide_lists_every_setting_with_its_default_and_meaning() -> None:
    config = DistillConfig()
    assert_guide_lists({"": config, "teachers.": config.teachers, "train.": config.train}, "distill")
