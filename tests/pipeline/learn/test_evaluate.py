"""The command that measures policies, on the shared split, level files and sealed levels."""

import errno
import io
import json
import os
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from rich.console import Console

import levelproof
from benchmarks.published import write as write_published
from levelproof.experts.evaluation import do_nothing, play, play_most_probable, play_sampled
from levelproof.experts.networks.over_levels import PolicyKind
from levelproof.experts.networks.saved import save_policy
from levelproof.levelgen.batching import take
from levelproof.levelgen.files.kinetix import state_to_kinetix
from levelproof.levelgen.files.level_file import LevelFile, write_level_file
from levelproof.levelgen.level import size_of
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.task.rules import DEFAULT_RULES
from levelproof.pipeline.dataset.dataset import Dataset
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.exchange.level_json import export
from levelproof.pipeline.learn import evaluate, published
from levelproof.pipeline.learn.looks import LOOKS, log_look
from levelproof.pipeline.learn.measured import levels_in, midway_levels
from levelproof.pipeline.learn.sealed import SEALED_IDS
from levelproof.pipeline.learn.specialists import specialists_of
from levelproof.pipeline.read.agents import agent_in
from levelproof.pipeline.store.job_note import note_job
from levelproof.pipeline.store.manifest import read_manifest
from tests.pipeline.command import ROOT, assert_refused, here, run
from tests.pipeline.made import honest_split, made_job, small_policy

ONCE = ("--attempts", "1")  # another number compiles other programs


def facts(folder: Path, *words: str) -> dict:
    done = here(["evaluate", *words, "--json"], folder)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def policy_in(folder: Path, kind: PolicyKind, size: str | None) -> Path:
    save_policy(folder / "policy", small_policy(size_of(size) if size else None, kind))
    return folder / "policy"


@pytest.mark.slow
def test_experts_of_a_split_stand_beside_the_baselines(split: Path, tmp_path: Path) -> None:
    """Their rates are those of the rows; levels that the split lacks are named."""
    rows = read_manifest(split).table.sort_by("level_id").to_pylist()
    ids = np.array([row["level_id"] for row in rows])
    group = next(levels_in(split, None, None, print))
    chosen = lambda some: group._replace(level_ids=group.level_ids[some], levels=take(group.levels, some))
    found = specialists_of(split, chosen(np.arange(len(ids))[::-1]), 16)
    assert found
    name, solved = found
    assert name.startswith("its own expert, ")
    expected = [1.0 if row["label"] == "trivial" else row["success_rate"] or 0.0 for row in rows]
    np.testing.assert_allclose(solved.mean(1)[::-1], expected, atol=1e-6)
    assert 0 < np.mean(expected) < 1
    fewer = specialists_of(split, group, 3)
    assert fewer
    assert fewer.solved.shape == (len(ids), 3)
    pair = chosen(np.arange(2))
    with pytest.raises(UserError, match=r"lacks 1 of the levels, such as 2000000000:"):
        specialists_of(split, pair._replace(level_ids=np.array([ids[0], 2_000_000_000])), 1)
    with pytest.raises(UserError, match=rf"has other levels with the ids of .*, such as {ids[0]}: name a split"):
        specialists_of(split, pair._replace(level_ids=ids[[1, 0]]), 1)
    labelled = ROOT / "manifests" / "16k" / "m"
    with pytest.raises(UserError, match="16k/m has no success rates, because procedure=label"):
        specialists_of(labelled, next(levels_in(labelled, "level_id < 3", None, print)), 1)
    for others in group, group._replace(level_ids=group.level_ids + 10**9):
        assert specialists_of(labelled, others, 1) is None, "levels of another size"
    drifted = pair.levels.state.position + np.float32(1e-6)  # as a GPU may round
    rounded = pair._replace(levels=replace(pair.levels, state=replace(pair.levels.state, position=drifted)))
    assert specialists_of(split, rounded, 1)
    model = group.levels.model
    stronger = group._replace(levels=replace(group.levels, model=replace(model, motor_power=model.motor_power * 2)))
    with pytest.raises(UserError, match="has other levels with the ids of"):  # of another distribution
        specialists_of(split, stronger, 1)
    done = here(["evaluate", "--on", str(split), "--experts", str(labelled), *ONCE], tmp_path)
    assert_refused(done, 2, "16k/m are not of size s: name another split with --experts")
    words = "--on", str(split), "--experts", str(split), str(split), "--levels", "4", *ONCE
    (group,) = facts(tmp_path, *words)["levels"]
    assert list(group["of"]["all"])[-2:] == [name, f"{name}, {split}"], "none replaces another of its budget"


@pytest.mark.campaign
def test_command_measures_policy_and_baselines_on_a_split(split: Path, tmp_path: Path) -> None:
    policy = policy_in(tmp_path, PolicyKind.ATTENTION, None)
    words = [str(policy), "--on", str(split), "--attempts", "3", "--levels", "12"]
    measured = facts(tmp_path, *words)
    (group,) = measured["levels"]
    names = ["doing nothing", "random", "sticky random", "policy, sampled", "policy, greedy"]
    assert set(group["of"]) == {"all", "that doing nothing does not solve", "labelled solved"}
    assert all(list(players) == names for players in group["of"].values())
    assert group["of"]["that doing nothing does not solve"]["doing nothing"]["once"]["rate"] == 0
    every = group["of"]["all"]["random"]
    assert every["once"]["rate"] <= every["best"]["rate"]
    table = run(["evaluate", *words], tmp_path)
    assert "policy, greedy" in table.stdout
    assert "..." not in table.stdout
    assert max(map(len, table.stdout.splitlines())) <= 80 + len(str(split))


def test_command_measures_sealed_levels_without_a_policy(tmp_path: Path) -> None:
    (group,) = facts(tmp_path, "--levels", "16", *ONCE)["levels"]
    assert group["levels"] == "sealed s"
    assert group["of"]["all"]["random"]["levels"] == 16
    assert group["of"]["all"]["random"]["worst"] is None


def test_command_names_level_files_that_it_leaves_out(split: Path, tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    export(split, int(read_manifest(split).level_ids[0]), folder / "good.json")
    (folder / "damaged.json").write_text("{")
    done = here(["evaluate", "--on", "mine", *ONCE, "--json"], tmp_path)
    assert done.returncode == 0, done.stderr
    assert "damaged.json" in done.stderr
    (group,) = json.loads(done.stdout)["levels"]
    assert group["of"]["all"]["random"]["levels"] == 1


def test_level_files_of_a_size_that_no_distribution_makes_are_measured(tmp_path: Path) -> None:
    size = size_of("6-0-1-0")
    with pytest.raises(ValueError, match="no room for the actuators"):
        made_job("data", "size=6-0-1-0")
    (tmp_path / "mine").mkdir()
    write_level_file(LevelFile(empty_level(size, 1), DEFAULT_RULES), tmp_path / "mine/level.json")
    (group,) = levels_in(tmp_path / "mine", None, None, print)
    assert group.levels.size == size


def test_split_in_which_nothing_is_committed_is_named(tmp_path: Path) -> None:
    job = made_job("data")
    (tmp_path / "data/128k/s").mkdir(parents=True)
    note_job(tmp_path / "data/128k/s", job, ["levelproof", "generate"], [(0, 3)])
    done = here(["evaluate", "--on", "data/128k/s", *ONCE], tmp_path)
    assert_refused(done, 2, "Nothing is committed in data/128k/s yet")
    (tmp_path / "data").rename(tmp_path / "my data")
    done = here(["train", "levels=my data/128k/s", "-o", "policy"], tmp_path)
    assert_refused(done, 2, "Nothing is committed in my data/128k/s yet: `levelproof status 'my data/128k/s'` shows")


def test_folder_of_splits_is_named(split: Path, tmp_path: Path) -> None:
    """Its JSON files are those of the splits, not levels."""
    shutil.copytree(split, tmp_path / "data/128k/s")
    for words in (["evaluate", "--on", "data", *ONCE], ["train", "levels=data", "-o", "policy"]):
        assert_refused(here(words, tmp_path), 2, "data is not a split, but a folder of 1")
    done = here(["inspect", "data/128k/s", "--against", "data"], tmp_path)
    assert_refused(done, 2, "data is not a split, but a folder of 1")
    done = here(["train", "levels=learnabilty", "-o", "policy"], tmp_path)
    assert_refused(done, 2, "no levels at learnabilty (did you mean learnability?)")


def test_levels_in_place_of_a_policy_are_named(split: Path, tmp_path: Path) -> None:
    shutil.copytree(split, tmp_path / "data/128k/s")
    (tmp_path / "level.json").touch()
    for levels in "data/128k/s", "level.json":
        sentence = f"{levels} is not a policy: name a policy's folder; levels go after --on"
        assert_refused(here(["evaluate", levels, *ONCE], tmp_path), 2, sentence)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["nowhere"], "There is no policy in nowhere"),
        (["--where", "label = 'solved'"], "name one with --on"),
        (["--attempts", "0"], "--attempts is 0"),
        (["--size", "huge"], "set --size to s, m or l"),
        (["--size", "s", "huge"], "set --size to s, m or l"),
        (["--on", "nowhere"], "There are no levels at nowhere"),
        (["--on", "nowhere", "--size", "s"], "--size selects"),
        (["--on", "handmade", "--size", "8-8-8-4"], "set --size to s, m or l"),
        (["--on", "handmade", "--where", "label = 'solved'"], "name one with --on"),
        (["--start", "0.5"], "name one with --on"),
        (["--start", "1"], "--start is 1.0"),
        (["--against", "builtin:s"], "name the first one before it"),
        (["--experts", "some/split", "--start", "0.5"], "leave out --start"),
        (["--seed", "-1"], "--seed is -1"),
        (["nowhere.py"], "There is no agent at nowhere.py"),
    ],
)
def test_evaluate_refuses_invalid_arguments(tmp_path: Path, words: list[str], sentence: str) -> None:
    assert_refused(here(["evaluate", *words], tmp_path), 2, sentence)


@pytest.mark.slow
def test_policies_are_compared_on_the_same_levels_and_both_looks_are_logged(tmp_path: Path) -> None:
    """An agent against itself draws the same numbers; sealed ids in a split are sealed levels, too."""
    act = "def act(observation, live, uniform):\n    return (uniform * [3, 3, 3, 3, 2, 2]).astype(int)\n"
    for name in ("one.py", "two.py"):
        (tmp_path / name).write_text(act)
    (tmp_path / "three.py").write_text(act.replace("uniform *", "0 * uniform *"))
    split = tmp_path / "seeds.parquet"
    done = here(["generate", "procedure=label", "budget=16k", "levels=32", f"first_level={SEALED_IDS.start - 16}",
                 "out=d", "executor=inline", "search.env_steps=4096", "search.variations=0"], tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert here(["export", "d/16k/s", "--format", "seed", "-o", str(split)], tmp_path).returncode == 0
    (same,) = facts(tmp_path, "one.py", "--against", "two.py", "--on", str(split), "--attempts", "2")["levels"]
    assert same["of"]["all"]["agent"] == same["of"]["all"]["other"]
    assert same["difference"]["all"]["rate"] == 0
    for name in ("one", "two"):
        (look,) = (tmp_path / f"{name}.{LOOKS}").read_text().splitlines()
        assert json.loads(look)["on"] == {
            f"{split}, s": {"levels": 16, "solved": same["of"]["sealed"]["agent"]["once"]["rate"]}
        }
    done = here(["evaluate", "one.py", "--against", "three.py", "--levels", "32", "--attempts", "2"], tmp_path)
    assert re.search(r"agent minus other, one attempt, level by level: [+-]\d+\.\d points \([+-]", done.stdout)
    assert (tmp_path / f"three.{LOOKS}").read_text().count("\n") == 1


@pytest.mark.slow
def test_agent_in_a_python_file_plays_as_a_player_does(tmp_path: Path) -> None:
    (tmp_path / "agent.py").write_text(
        "import neighbour, numpy\n\n\ndef act(observation, live, uniform):\n"
        "    assert observation.shape[1] == 140 and live.shape == uniform.shape\n"
        "    return (uniform * numpy.array([3, 3, 3, 3, 2, 2])).astype(int)\n"
    )
    (tmp_path / "neighbour.py").touch()
    (group,) = facts(tmp_path, "agent.py", "--levels", "32", *ONCE)["levels"]
    for players in group["of"].values():
        assert players["agent"] == players["random"]
    (look,) = (tmp_path / f"agent.{LOOKS}").read_text().splitlines()
    assert json.loads(look)["on"]["sealed s"]["solved"] == group["of"]["all"]["random"]["once"]["rate"]


def test_agents_import_neighbours_of_the_same_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])
    for choice in (0, 1):
        (folder := tmp_path / str(choice)).mkdir()
        (folder / "net.py").write_text(f"choice = {choice}")
        (folder / "late.py").write_text(f"choice = {choice}")
        (folder / "agent.py").write_text(
            "import numpy, net\n\n\ndef act(seen, live, uniform):\n"
            "    import late\n\n    assert net.choice == late.choice\n"
            "    return numpy.full(uniform.shape, late.choice)\n"
        )
    zero, one = (agent_in(tmp_path / str(choice) / "agent.py") for choice in (0, 1))
    for _ in range(2):
        for choice, agent in enumerate((zero, one)):
            assert (agent._actions(*np.zeros((3, 6, 4))) == choice).all(), agent.error
    assert not {"net", "late"} & sys.modules.keys()


@pytest.mark.parametrize(
    ("source", "sentence"),
    [
        ("", "agent.py defines no function act"),
        ("import nothing_like_this", "agent.py failed: ModuleNotFoundError"),
        pytest.param("def act(*seen): raise ValueError('no')", "failed: ValueError: no", marks=pytest.mark.slow),
        pytest.param("def act(*seen): return seen[2]", "returned float32", marks=pytest.mark.slow),
        pytest.param("def act(*seen): return seen[1] + 7", "returned choices out of range", marks=pytest.mark.slow),
    ],
)
def test_agent_that_cannot_play_is_refused(source: str, sentence: str, tmp_path: Path) -> None:
    (tmp_path / "agent.py").write_text(source)
    assert_refused(here(["evaluate", "agent.py", "--levels", "1", *ONCE], tmp_path), 2, sentence)


def test_command_refuses_a_policy_of_another_size(tmp_path: Path) -> None:
    policy = policy_in(tmp_path, PolicyKind.FLAT, "m")
    assert_refused(here(["evaluate", str(policy), "--levels", "8"], tmp_path), 2, "plays levels of size m only")


@pytest.mark.slow
def test_each_look_at_the_sealed_levels_is_logged(tmp_path: Path) -> None:
    policy = policy_in(tmp_path, PolicyKind.FLAT, "s")  # compiles fastest
    for look in (1, 2):
        done = here(["evaluate", str(policy), "--levels", "4", *ONCE], tmp_path)
        assert done.returncode == 0, done.stderr
        assert f"Evaluation {look} of this policy on sealed levels" in done.stderr
    looks = [json.loads(line) for line in (policy / LOOKS).read_text().splitlines()]
    assert [look["on"]["sealed s"]["levels"] for look in looks] == [4, 4]
    assert {look["attempts"] for look in looks} == {1}


def test_linked_log_of_looks_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "published").touch()
    (tmp_path / LOOKS).symlink_to(tmp_path / "published")
    assert log_look(tmp_path / LOOKS, "policy", [], 1, 0) is None
    assert not (tmp_path / "published").read_text()


def test_look_is_logged_on_a_line_of_its_own_after_one_that_was_cut_off(tmp_path: Path) -> None:
    (tmp_path / LOOKS).write_text('{"at": "2026-')
    assert [log_look(tmp_path / LOOKS, "policy", [], 1, seed) for seed in (7, 8)] == [2, 3]
    cut_off, *looks = (tmp_path / LOOKS).read_text().splitlines()
    assert cut_off == '{"at": "2026-'
    assert [json.loads(look)["seed"] for look in looks] == [7, 8]


def test_look_that_cannot_be_logged_is_told_unless_the_policy_comes_with_levelproof(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("agent.py").write_text("def act(seen, live, uniform): return uniform")
    Path(f"agent.{LOOKS}").mkdir()
    said = {}
    for name in ("agent.py", "builtin:s"):
        console = Console(file=io.StringIO(), width=200)
        evaluate._log(evaluate._contestant(Path(name), "policy"), [], 1, 0, console)
        said[name] = console.file.getvalue()
    assert said == {
        "agent.py": f"Cannot write agent.{LOOKS}, so this evaluation is not recorded.\n",
        "builtin:s": "",
    }


@pytest.mark.slow
def test_attempts_start_within_witnesses(tmp_path: Path) -> None:
    """What is left of a witness solves its level from there, in as many steps as are left."""
    split = honest_split(tmp_path / "data", 32, 1)
    group = midway_levels(Dataset(split, None, (), 0.0), None, 0.5)
    data = levelproof.open(split)
    rows = [data.manifest["level_id"].to_pylist().index(level_id) for level_id in group.level_ids.tolist()]
    steps = np.array([data.manifest["steps_to_goal"][row].as_py() for row in rows])
    assert len(rows) > 3
    actions = data.read(rows, observation=None).action  # [level, time, 6]
    left = np.stack([np.roll(of_level, -(n // 2), 0) for of_level, n in zip(actions, steps, strict=True)])
    follow = lambda params, moment: params[moment.now.timestep[0]]
    played = play(follow, left.transpose(1, 2, 0), group.levels, group.level_ids, 1, 0, group.rules, lanes=len(rows))
    assert played.solved.all()
    np.testing.assert_array_equal(played.env_steps[:, 0], steps - steps // 2)
    halves = facts(tmp_path, "--on", str(split), "--start", "0", "0.5", *ONCE)["levels"]
    assert [half["start"] for half in halves] == [0, 0.5]
    assert {half["of"]["all"]["random"]["levels"] for half in halves} == {len(rows)}


@pytest.fixture
def published_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder for the reference's levels, of which there are three of size s."""
    monkeypatch.setattr(published, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(published, "HANDMADE_LEVELS", {"s": 3})
    monkeypatch.setattr(published, "RANDOM_LEVELS", 3)
    return tmp_path / "published"


def test_levels_of_the_reference_are_played_by_its_protocol(
    published_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    levels = jax.device_get(levelproof.sample_levels(np.arange(3), "s"))
    folder = published_folder / "handmade" / "s"
    folder.mkdir(parents=True)
    for i in range(3):
        levelproof.write_level_file(
            levelproof.LevelFile(take(levels, np.array([i])), DEFAULT_RULES), folder / f"{i}.json"
        )
    state = state_to_kinetix(levels, levels.state, np.zeros(3), np.zeros(3))
    np.savez(published.random_file("s"), **state)  # pyright: ignore[reportArgumentType]
    played = {}
    for name, attempts, rate in ("handmade", 20, 0.42), ("reference-random", 5, 0.33):
        assert published.PROTOCOLS[name].attempts == attempts
        monkeypatch.setitem(published.PROTOCOLS, name, published.PROTOCOLS[name]._replace(attempts=1))
        measured = facts(tmp_path, "--on", name, "--size", "s")
        assert measured["attempts"] == 1
        (group,) = measured["levels"]
        assert group["published"]["sfl-paper"] == rate
        played[name] = group["of"]["all"]["doing nothing"]
    assert played["handmade"]["levels"] == 3
    assert played["handmade"] == played["reference-random"]
    (group,) = facts(tmp_path, "--on", "handmade", "--size", "s", "--levels", "2")["levels"]
    assert not group["published"], "the published rate is that of all levels"
    (folder / "2.json").write_text("{")
    done = here(["evaluate", "--on", "handmade", "--size", "s"], tmp_path)
    assert_refused(done, 1, f"The folder {folder} does not have the 3 handmade levels of size s")


def test_missing_levels_of_the_reference_are_explained(
    published_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(published.sys, "executable", str(tmp_path / "python"))
    words = ["evaluate", "--size", "s", "--on"]
    assert_refused(here([*words, "handmade"], tmp_path), 2, "pip download --no-deps kinetix-env==3.0.2")
    assert_refused(here([*words, "reference-random"], tmp_path), 2, "python -m benchmarks.published")
    for damaged in b"damaged", b"":
        published.random_file("s").write_bytes(damaged)
        assert_refused(here([*words, "reference-random"], tmp_path), 1, "delete it and write it again")


def test_levels_of_the_reference_need_a_folder_that_can_be_written(
    published_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(published, "scratch", full)
    done = here(["evaluate", "--size", "s", "--on", "handmade"], tmp_path)
    assert_refused(done, 1, "Cannot write the handmade levels to", "No space left", "set LEVELPROOF_CACHE_DIR")


@pytest.mark.campaign
def test_handmade_levels_are_fetched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reference: Path) -> None:
    monkeypatch.setattr(published, "cache_folder", lambda: tmp_path)
    folder = published.handmade_folder()
    assert len([*folder.rglob("*.json")]) == 74


@pytest.mark.campaign
def test_random_levels_of_the_reference_are_hardly_solved_by_doing_nothing(reference: Path) -> None:
    write_published("s")
    (group,) = published.published_levels("reference-random", ["s"], None, print)
    played = play(do_nothing, (), group.levels, group.level_ids, 1, 0, group.rules)
    assert len(group.level_ids) == 512
    assert (played.solved & (played.env_steps <= 64)).mean() < 0.01


def test_rows_of_a_policy_are_named_by_how_it_plays() -> None:
    one = evaluate._contestant(Path("builtin:s"), "policy")
    assert one.policy
    players = play_sampled(one.policy.network), play_most_probable(one.policy.network)
    assert [*one.entrants] == [one.main, "policy, greedy"] == ["policy, sampled", "policy, greedy"]
    assert tuple(entrant.player for entrant in one.entrants.values()) == players
    assert [entrant.chance for entrant in one.entrants.values()] == [True, False]
