"""Training of a policy by reinforcement on a small real split, on level files and on random levels."""

import json
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from safetensors.numpy import load_file

import levelproof
from levelproof.configs.convert import plain
from levelproof.configs.train import TrainConfig
from levelproof.experts.generalist.config import EvolveConfig, LearnabilityConfig, PPOConfig, ReplayConfig
from levelproof.experts.generalist.train import _programs as programs
from levelproof.experts.networks.saved import Policy, policy_folder
from levelproof.levelgen.files.level_file import LevelFile, write_level_file
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.task.lanes import FIRST_EXTRA
from levelproof.levelgen.task.rules import DEFAULT_RULES
from levelproof.pipeline.exchange.level_json import export
from levelproof.pipeline.learn import measured, sealed, trained_on
from levelproof.pipeline.learn import run as writer
from levelproof.pipeline.learn import train as module
from levelproof.pipeline.learn.measured import levels_in
from levelproof.pipeline.learn.metrics import Metrics
from levelproof.pipeline.learn.trained_on import levels_for
from tests.pace import patience, wait_until
from tests.pipeline.command import COMMAND_SECONDS, assert_refused, heed_ctrl_c, here, run, start
from tests.pipeline.learn.runs import assert_average_is_kept, assert_guide_lists, metrics, stop_in_first_update

LANES = (
    "ppo.environments=64",
    "ppo.horizon=32",
    "ppo.minibatches=4",
    "ppo.epochs=2",
    "ppo.learning_rate=2e-3",
    "cores=1",
)
TINY = ("network.width=8", "network.depth=1", "network.heads=1")
PER_UPDATE = 64 * 32 * PPOConfig().repeat
FILES = ("policy.safetensors", "checkpoint.safetensors", "config.json")


def trained(folder: Path, updates: int, *words: str) -> Path:
    folder.mkdir(exist_ok=True)
    steps = f"ppo.env_steps={updates * PER_UPDATE}"
    done = here(["train", "-o", "agent", steps, *LANES, *words], folder)
    assert done.returncode == 0, done.stderr
    return folder / "agent"


@pytest.fixture(scope="module")
def easy(split: Path) -> tuple[str, ...]:
    return f"levels={split}", "where=label = 'solved'", *TINY


@pytest.fixture(scope="module")
def agent(easy: tuple[str, ...], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(tmp_path_factory.mktemp("trained"), 2, *easy)


@pytest.mark.slow
def test_solve_rate_rises_on_an_easy_set(easy: tuple[str, ...], tmp_path: Path) -> None:
    curve = metrics(trained(tmp_path, 60, "interval=10", *easy))
    assert [line["train/env_steps"] for line in curve] == [10 * PER_UPDATE * n for n in range(1, 7)]
    rate = [line["train/solve_rate"] for line in curve]
    assert np.mean(rate[-2:]) > np.mean(rate[1:3]) + 0.05, rate  # the first line has none but short episodes
    assert curve[-1]["train/return"] > curve[1]["train/return"]


def test_metrics_leave_out_numbers_that_do_not_exist(tmp_path: Path) -> None:
    """No episode may end in an interval, and then there is no solve rate. JSON has no NaN."""
    log = Metrics(tmp_path, module.COURSE, "none", {}, 0, print, list)
    log.write({module.COURSE.step: 1, "loss/value": 0.5, "train/solve_rate": np.nan})
    assert metrics(tmp_path) == [{module.COURSE.step: 1, "loss/value": 0.5}]
    assert (tmp_path / "curves.png").exists()


def test_folder_holds_the_average_of_the_weights(agent: Path) -> None:
    assert_average_is_kept(agent, ".average", ".params.policy")


@pytest.mark.campaign
def test_diverged_weights_are_not_kept(easy: tuple[str, ...], tmp_path: Path) -> None:
    lanes = [word for word in LANES if "learning_rate" not in word]
    steps = f"ppo.env_steps={2 * PER_UPDATE}"
    done = here(["train", "-o", "agent", steps, "ppo.learning_rate=1e30", *lanes, *easy], tmp_path)
    assert_refused(done, 1, "the weights have diverged", "a smaller ppo.learning_rate")
    assert not (tmp_path / "agent" / "policy.safetensors").exists()


@pytest.mark.slow
def test_folder_holds_a_policy_that_loads_and_is_evaluated(agent: Path, split: Path) -> None:
    policy = levelproof.load_policy(agent)
    assert policy.origin["env_steps"] == 2 * PER_UPDATE
    assert (agent / "config.json").stat().st_size < 4_000
    done = here(["evaluate", str(agent), "--on", str(split), "--levels", "8", "--attempts", "1"], agent.parent)
    assert done.returncode == 0, done.stderr
    assert (agent / "curves.png").read_bytes().startswith(b"\x89PNG")
    done = here(["gallery", str(split), "-o", "site", "--policy", str(agent)], agent.parent)
    assert done.returncode == 0, done.stderr
    assert '"policy"' in (agent.parent / "site" / "data" / "about.js").read_text()


def test_run_that_was_stopped_continues_bit_for_bit(
    easy: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    continues_bit_for_bit(easy, tmp_path, monkeypatch)


def test_finished_run_continues_to_more_env_steps(easy: tuple[str, ...], tmp_path: Path) -> None:
    whole = trained(tmp_path / "whole", 3, *easy)
    longer = trained(tmp_path / "longer", 1, *easy)
    assert trained(tmp_path / "longer", 3, *easy, "interval=3") == longer
    for name in (*FILES, "run.json"):
        assert (longer / name).read_bytes() == (whole / name).read_bytes()
    shorter = here(["train", "-o", "agent", f"ppo.env_steps={2 * PER_UPDATE}", *LANES, *easy], tmp_path / "longer")
    assert_refused(shorter, 2, f"agent has {3 * PER_UPDATE:,} env steps of training already")
    assert json.loads((longer / "run.json").read_text())["settings"]["ppo"]["env_steps"] == 3 * PER_UPDATE


@pytest.mark.campaign
def test_stopped_run_with_edited_levels_continues_bit_for_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = "levels=evolve", "replay.capacity=16", "evolve.children=8", "evolve.every=1", *TINY
    kept = load_file(continues_bit_for_bit(words, tmp_path, monkeypatch) / "checkpoint.safetensors")
    (index,) = (x for name, x in kept.items() if name.endswith(".level_index") and ".buffer" in name)
    assert (index >= FIRST_EXTRA).any()


@pytest.mark.campaign
def test_stopped_run_on_two_cores_continues_bit_for_bit(split: Path, tmp_path: Path) -> None:
    """In processes of their own: JAX's devices are fixed once it has started."""
    words = [f"levels={split}", f"ppo.env_steps={20 * PER_UPDATE}", *LANES[:-1], "cores=2", "interval=1", *TINY]
    for name in ("whole", "stopped"):
        (tmp_path / name).mkdir()
    assert run(["train", "-o", "agent", *words], tmp_path / "whole").returncode == 0
    process = start(["train", "-o", "agent", *words], tmp_path / "stopped", preexec_fn=heed_ctrl_c)
    wait_until((tmp_path / "stopped/agent/policy.safetensors").exists, COMMAND_SECONDS)
    process.send_signal(signal.SIGINT)
    assert process.wait(patience(COMMAND_SECONDS)) == 130
    assert load_file(tmp_path / "stopped/agent/checkpoint.safetensors")[".updates"] < 20
    assert run(["train", "-o", "agent", *words], tmp_path / "stopped").returncode == 0
    for name in FILES:
        assert (tmp_path / "stopped/agent" / name).read_bytes() == (tmp_path / "whole/agent" / name).read_bytes()


def continues_bit_for_bit(words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    words = ("interval=2", *words)
    whole = trained(tmp_path / "whole", 4, *words)
    made = programs.cache_info().misses
    stop_in_first_update(monkeypatch)
    (tmp_path / "stopped").mkdir()
    words_of_four = ["train", "-o", "agent", f"ppo.env_steps={4 * PER_UPDATE}", *LANES, *words]
    assert here(words_of_four, tmp_path / "stopped").returncode == 130
    assert load_file(tmp_path / "stopped/agent/checkpoint.safetensors")[".updates"] == 1
    monkeypatch.undo()
    out = trained(tmp_path / "stopped", 4, *words)
    assert programs.cache_info().misses == made, "equal runs share their programs"
    for name in FILES:
        assert (out / name).read_bytes() == (whole / name).read_bytes()
    assert metrics(out)[-1]["train/return"] == metrics(whole)[-1]["train/return"]
    return out


def test_levels_are_on_the_cores_before_the_first_update(
    easy: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tables = list[Any]()
    trains = lambda programs, learner, table, *_: tables.append(table) or learner
    monkeypatch.setattr(module, "update_until_done", trains)
    trained(tmp_path, 2, *easy)
    assert {x.committed and x.sharding.is_fully_replicated for x in jax.tree.leaves(tables)} == {True}


@pytest.mark.slow
def test_run_killed_before_its_checkpoint_repeats_the_line_of_its_metrics(
    easy: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keep, kept = writer.keep_run, list[Any]()

    def killed(out: Path, policy: Policy, learner: Any) -> None:
        kept.append(learner)
        if len(kept) == 2:
            raise KeyboardInterrupt
        keep(out, policy, learner)

    monkeypatch.setattr(writer, "keep_run", killed)
    words = ["train", "-o", "agent", f"ppo.env_steps={3 * PER_UPDATE}", "interval=1", *LANES, *easy]
    assert here(words, tmp_path).returncode == 130
    stopped = metrics(tmp_path / "agent")
    assert [line["train/updates"] for line in stopped] == [1, 2]
    assert here(words, tmp_path).returncode == 0
    curve = metrics(tmp_path / "agent")
    assert [line["train/updates"] for line in curve] == [1, 2, 3]
    assert curve[0] == stopped[0]


@pytest.mark.slow
def test_start_keeps_its_weights_while_the_critic_fits(
    agent: Path, split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[dict[str, np.ndarray]] = []  # after each update
    keep = writer.keep_run

    def noted(out: Path, *arguments: Any) -> None:
        keep(out, *arguments)
        kept.append(load_file(out / "policy.safetensors"))

    monkeypatch.setattr(writer, "keep_run", noted)
    words = (f"levels={split}", f"start={agent}", "ppo.critic_updates=2", "ppo.kl_weight=0.2")
    words = (*words, "ppo.kl_updates=2", "interval=1")
    curve = metrics(trained(tmp_path, 5, *words))
    origin = levelproof.load_policy(tmp_path / "agent").origin
    assert origin["start_origin"] == levelproof.load_policy(agent).origin
    assert "network" not in origin["settings"], "the start gives it"
    before = load_file(agent / "policy.safetensors")
    same = [all((weights[name] == before[name]).all() for name in before) for weights in kept[:5]]
    assert same == [True, True, False, False, False]
    kl = [line["loss/kl_to_start"] for line in curve]
    assert max(kl[:2]) < 1e-6
    assert kl[3] > max(kl[:2])
    assert kl[4] == 0, "the penalty is over, and the start's logits are not computed any more"
    assert any(name.startswith(".params.value") for name in load_file(tmp_path / "agent/checkpoint.safetensors"))


@pytest.mark.campaign
@pytest.mark.parametrize("of_split", [False, True])
def test_levels_are_measured_for_learnability(of_split: bool, split: Path, tmp_path: Path) -> None:
    levels = (f"levels={split}", "choice=learnability") if of_split else ("levels=learnability", "size=s")
    out = trained(tmp_path, 3, *levels, "curriculum.candidates=64", "curriculum.keep=16", "curriculum.every=2", *TINY)
    kept = load_file(out / "checkpoint.safetensors")
    usable = next(x for name, x in kept.items() if name.endswith("usable"))
    assert 0 < usable <= 16
    assert metrics(out)[-1]["curriculum/usable"] == usable


@pytest.mark.campaign
@pytest.mark.parametrize("of_split", [False, True])
def test_levels_are_replayed(of_split: bool, split: Path, tmp_path: Path) -> None:
    levels = (f"levels={split}", "choice=replay") if of_split else ("levels=replay",)
    out = trained(tmp_path, 6, *levels, "replay.capacity=8", "replay.full_enough=1", *TINY)
    kept = {name: x for name, x in load_file(out / "checkpoint.safetensors").items() if name.startswith(".curriculum")}
    assert kept[".curriculum.cumulative"][-1] > 0
    assert np.isfinite(kept[".curriculum.score"]).all()
    assert metrics(out)[-1]["curriculum/replaying"] == metrics(out)[-1]["curriculum/filled"] == 1


def test_level_sources(split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    messages: list[str] = []
    with monkeypatch.context() as patch:
        patch.setattr(measured, "LEVELS_AT_ONCE", 3)
        patch.setattr(trained_on, "content_hashes", None)  # those of the rows are known
        source = levels_for(TrainConfig(levels=str(split), where="label = 'solved'"), messages.append)
    data = levelproof.open(split, where="label = 'solved'")
    ids = data.manifest["level_id"].to_pylist()
    assert source.facts["count"] == len(source.levels) == len(ids)
    assert np.array_equal(source.levels.state.position, data.levels(np.arange(len(ids))).state.position)
    fewer = levels_for(TrainConfig(levels=str(split), where=f"label = 'solved' AND level_id > {ids[0]}"), print)
    assert source.facts["content"] != fewer.facts["content"]
    midway = levels_for(TrainConfig(levels=str(split), where="label = 'solved'", starts=2), print)
    assert midway.facts == source.facts | {"states": midway.facts["states"]}, "the settings of the note have starts"
    at = np.array(data.manifest["steps_to_goal"].to_pylist()) // 2
    half = np.moveaxis(data.state(np.arange(len(ids)), at).level.state.position, 0, -1)
    assert np.array_equal(midway.levels.state.position, np.append(source.levels.state.position, half, -1))
    export(split, ids[0], tmp_path / "level.json")
    of_files = levels_for(TrainConfig(levels=str(tmp_path)), messages.append)
    assert of_files.facts["count"] == 1
    assert not messages
    with monkeypatch.context() as patch:
        [group] = levels_in(split, "label = 'solved'", None, print)
        ruled = group._replace(rules=replace(group.rules, dense_reward_scale=0.5))
        patch.setattr(trained_on, "_groups", lambda *_: [ruled])
        facts = levels_for(TrainConfig(levels=str(split), where="label = 'solved'"), print).facts
    assert facts == source.facts | {"rules": [*source.facts.get("rules", []), "task.dense_reward_scale=0.5"]}
    (tmp_path / "two").mkdir()
    shutil.copy(tmp_path / "level.json", tmp_path / "two")
    write_level_file(LevelFile(empty_level(SIZES["m"], 1), DEFAULT_RULES), tmp_path / "two/m.json")
    with pytest.raises(levelproof.UserError, match=r"levels of the sizes [sm], [sm]: train on files of one size"):
        levels_for(TrainConfig(levels=str(tmp_path / "two")), print)
    shutil.rmtree(tmp_path / "two")
    first = ids[0]
    monkeypatch.setattr(sealed, "SEALED_IDS", range(first, first + 2))
    with pytest.raises(levelproof.UserError, match=f'sealed to measure policies.*where="level_id < {first}"'):
        levels_for(TrainConfig(levels=str(split), where=""), print)
    with pytest.raises(levelproof.UserError, match=rf"where=\"\(label = 'solved'\) AND level_id < {first}\""):
        levels_for(TrainConfig(levels=str(split), where="label = 'solved'"), print)
    monkeypatch.setattr(sealed, "sealed_hashes", lambda: frozenset(data.content_hashes))
    with pytest.raises(levelproof.UserError, match="only copies of sealed levels"):
        levels_for(TrainConfig(levels=str(tmp_path)), print)  # their content, whatever their ids


@pytest.mark.parametrize(
    ("noted", "asked", "own", "backend", "cores", "prepared"),
    [
        (2, 0, 4, "cpu", 2, 2),
        (2, 4, 4, "cpu", 2, 2),
        (0, 0, 4, "cpu", 4, 4),
        (0, 0, 7, "cpu", 4, 4),
        (0, 0, 3, "cpu", 2, 2),
        (0, 0, 9, "cpu", 4, 8),  # JAX was set up for fewer before
        (0, 1, 4, "cpu", 1, 1),
        (3, 0, 4, "cpu", 4, 4),
        (3, 2, 4, "cpu", 2, 2),
        (0, 0, 4, "gpu", 1, 4),
    ],
)
def test_resumed_run_keeps_its_cores_and_a_new_one_takes_what_divides_its_lanes(
    noted: int, asked: int, own: int, backend: str, cores: int, prepared: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = list[int]()
    monkeypatch.setattr(module, "prepare_jax", lambda devices: told.append(devices))
    monkeypatch.setattr(module, "own_cores", lambda: range(own))
    monkeypatch.setattr(module.jax, "devices", lambda: range(4))
    monkeypatch.setattr(module.jax, "default_backend", lambda: backend)
    note = {"cores": noted} if noted else None
    assert module.prepared_cores(TrainConfig(cores=asked), note) == cores
    assert told == [prepared]


def test_cores_for_which_jax_has_too_few_devices_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "prepare_jax", lambda devices: None)
    monkeypatch.setattr(module.jax, "devices", lambda: range(1))
    monkeypatch.setattr(module.jax, "default_backend", lambda: "cpu")
    for noted, asked in ((0, 3), (2, 0)):
        with pytest.raises(
            levelproof.UserError, match=f"cores is {noted or asked}, .*for 1 in this process: set cores=1"
        ):
            module.prepared_cores(TrainConfig(cores=asked), {"cores": noted})
    monkeypatch.setattr(module.jax, "default_backend", lambda: "gpu")
    for noted, asked, whose in ((0, 3, "The command asks for 3"), (2, 0, "The run so far used 2")):
        with pytest.raises(levelproof.UserError, match=f"{whose} cores, but JAX uses a GPU here: set JAX_PLATFORMS"):
            module.prepared_cores(TrainConfig(cores=asked), {"cores": noted})


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["ppo.env_step=3"], "did you mean ppo.env_steps?"),
        (["ppo.subsample=1.5"], "ppo.subsample is 1.5: it must be above 0 and at most 1"),
        (["size=6-0-1-0"], "Cannot sample levels: size is 6-0-1-0: it has no room for the actuators"),
        (["size=60-2-0-1"], "Cannot sample levels: size is 60-2-0-1: a level has at most"),
        (["ppo.repeat=257"], "ppo.repeat is 257: it must be between 1 and 256"),
        (["size=s", "levels=some/split"], "size has no effect"),
        (["where=label = 'solved'"], "where has no effect on random levels"),
        (["starts=4"], "starts has no effect on random levels"),
        (["starts=0", "levels=some/split"], "starts is 0"),
        (["starts=1M", "levels=some/split"], "starts is 1000000: it must be between 1 and 256"),
        (["distribution=kinetics"], "there is no distribution kinetics (did you mean kinetix?): choose one of"),
        (["start=~/nothing/here"], f"There is no policy in {Path.home()}/nothing/here"),
        (["starts=2", "levels=file"], "starts=2 needs witnesses, but file is not a split"),
        (["curriculum.keep=4"], "no effect with levels=uniform"),
        (["choice=learnability"], "choice has no effect on random levels"),
        (["levels=some/split", "curriculum.keep=4"], "no effect with choice=uniform"),
        (["levels=some/split", "choice=evolve"], "choice"),
        (
            ["levels=file", "where=level_id < 9"],
            "where=level_id < 9 selects levels of a split, but file is not a split",
        ),
        (["network.kind=flat", "network.heads=8"], "network.heads has no effect with network.kind=flat"),
        (["levels=replay", "replay.share=1"], "share is 1"),
        (["levels=replay", "evolve.edits=4"], "no effect with levels=replay"),
        (["levels=evolve", "replay.capacity=4"], "evolve.children is 64: it must not exceed 2"),
        (["ppo.kl_weight=1"], "no effect without start"),
        (["start=policy", "ppo.kl_updates=8"], "ppo.kl_updates has no effect without ppo.kl_weight"),
        (
            ["start=policy", "ppo.env_steps=4M"],
            "ppo.env_steps gives 8 updates, and the first 10 leave the policy as it is: raise ppo.env_steps",
        ),
        (
            ["levels=learnability", "curriculum.measured_steps=255"],
            "curriculum.measured_steps is 255, but episodes have up to 256 env steps",
        ),
        (["start=policy", "network.width=8"], "network.width cannot change the network of the policy in start"),
        (["distribution=kinetx"], "did you mean kinetix?"),
        (["size=q"], "Cannot sample levels"),
        (["start=none"], "There is no policy in none"),
        (["ppo.environments=500"], "environments is 500"),
        (["ppo.minibatches=7"], "minibatches is 7"),
        (["-o", "file"], "Cannot write a policy to file"),
    ],
)
def test_bad_input_is_refused_in_one_sentence(words: list[str], sentence: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert_refused(here(["train", "cores=1", *words], tmp_path), 2, sentence)
    assert not (tmp_path / "agent").exists()


def test_folder_of_another_run_is_refused(agent: Path, easy: tuple[str, ...], tmp_path: Path) -> None:
    shutil.copytree(agent, tmp_path / "agent")
    assert_refused(here(["train", *LANES, *easy, "seed=1"], tmp_path), 2, "has a run with other settings or levels")


def test_replay_of_too_few_levels_is_refused(split: Path, tmp_path: Path) -> None:
    done = here(["train", f"levels={split}", "choice=replay", *LANES, *TINY], tmp_path)
    assert_refused(
        done, 2, "choice=replay starts once 2,000 levels have been attempted", "set a smaller replay.capacity"
    )


@pytest.mark.parametrize("note", [{"splits": [], "settings": {"where": ""}}, {"settings": {"ppo": 1}}, {"cores": 7}])
def test_folder_with_the_note_of_another_command_is_refused(note: Any, tmp_path: Path) -> None:
    (tmp_path / "agent").mkdir()
    (tmp_path / "agent" / "run.json").write_text(json.dumps(note))
    assert_refused(here(["train", *LANES, *TINY], tmp_path), 2, "has a run with other settings or levels")


def test_note_has_the_start_and_every_setting_that_decides_a_run(tmp_path: Path) -> None:
    """The weights of the start may be linked, as those downloaded from the Hugging Face hub are."""
    for file in policy_folder("builtin:s").iterdir():
        (tmp_path / file.name).symlink_to(file)
    starts = ("", "builtin:s", "builtin:m", str(tmp_path))
    configs = [TrainConfig(start=start) for start in starts]
    notes = [module.note_of(config, levels_for(config, print), 1) for config in configs]
    scratch, small, medium, linked = (note["start"] for note in notes)
    assert scratch is None
    assert small == linked != medium
    assert plain(configs[0]).keys() - notes[0]["settings"].keys() == {"log", "interval", "cores"}


def test_guides_list_every_setting_with_its_default_and_meaning() -> None:
    groups = {"": TrainConfig(), "ppo.": PPOConfig(), "curriculum.": LearnabilityConfig()}
    assert_guide_lists(groups | {"replay.": ReplayConfig(), "evolve.": EvolveConfig()}, "finetune", "curricula")
