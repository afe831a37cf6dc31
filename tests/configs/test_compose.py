"""compose_job: override strings in, a typed job or an error of one sentence out."""

import dataclasses
import shlex
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from levelproof.configs.compose import (
    FOLDERS,
    _default,
    compose_job,
    default_presets,
    distributions,
    name_and_hash,
    presets,
    shortest_command,
)
from levelproof.configs.convert import flat, plain
from levelproof.configs.errors import ConfigError
from levelproof.configs.meanings import every_setting
from levelproof.configs.schema import WITHOUT_EFFECT, GrowConfig, ImportConfig
from levelproof.experts.config import ExpertConfig
from levelproof.levelgen.sampling.distribution import Distribution
from levelproof.levelgen.task.rules import TaskParams


def test_compose_job_without_overrides_returns_the_small_default_dataset() -> None:
    job = compose_job([])
    assert (job.size, job.level_ids, job.env_steps, job.budget, job.out) == ("s", range(64), 128_000, "128k", "data")
    assert (job.executor, job.workers) == ("auto", 0)


def test_compose_job_takes_defaults_from_the_dataclasses() -> None:
    job = compose_job([])
    assert (job.distribution, job.task, job.expert) == (Distribution(), TaskParams(), ExpertConfig())


def test_compose_job_applies_overrides_at_every_depth() -> None:
    job = compose_job(["size=m", "levels=1k", "first_level=5", "expert.learning_rate=1e-3", "task.physics.slop=0.02"])
    assert (job.size, job.level_ids) == ("m", range(5, 1005))
    assert job.expert.learning_rate == 1e-3
    assert job.task.physics.slop == 0.02


@pytest.mark.parametrize("text", ["a b", "é/x", "~/x=y", "a,b", "{x}", "$HOME", "[1]", "007", "a'b"])
def test_compose_job_accepts_any_path_as_out(text: str) -> None:
    assert compose_job([f"out={text}"]).out == text


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("size=x", "size is .x.: choose one of s, m, l, or give the numbers of polygons"),
        ("size=5-2-1-1", "size is 5-2-1-1: write s instead"),
        ("size=4-1-1-1", "size is 4-1-1-1: 4 polygons and 1 circles leave no room"),
        ("size=8-8-0-0", "size is 8-8-0-0: it has no room for the actuators"),
        ("size=5-1-1-0", "size is 5-1-1-0: it has no room for the actuators"),
        ("size=25-24-1-1", "size is 25-24-1-1: a level has at most 48 polygons and circles"),
        ("size=99-1-1-1", "at most 64 polygons"),
        ("levels=abc", "levels is 'abc': write a whole number such as"),
        ("levels=0", "levels is '0'"),
        ("levels=1.5", "not a whole number"),
        ("budget=0", "budget is '0'"),
        ("budget=1000", "one update of an expert takes 2048 env steps"),
        ("budget=3B", "budget is 3000000000: the maximum is 2147483647 env steps"),
        ("budget=", "budget is ''"),
        ("budgt=1k", r"no setting budgt \(did you mean budget\?\)"),
        ("expert.lerning_rate=1", r"no setting expert.lerning_rate \(did you mean expert.learning_rate\?\)"),
        ("expert.width=a", "expert.width is 'a': it must be a whole number"),
        ("expert.discount=3", "expert.discount is 3.0: it must be between 0 and 1"),
        ("distribution.floor_red_chance=2", "distribution.floor_red_chance is 2.0"),
        ("distribution=foo", "no distribution foo"),
        ("executor=rai", r"did you mean ray\?"),
        ("first_level=-1", "keep them between 0 and"),
        ("task.physics.dt=0", "task.physics.dt is 0.0: it must be between 1e-06 and 1"),
        ("task.physics.slop=-5", "task.physics.slop is -5.0: it must be between 0 and"),
        ("task.max_timesteps=3000000000", "task.max_timesteps is 3000000000: it must be between 1 and 1000000"),
        ("distribution.min_revolute_joints=99999999999", "distribution.min_revolute_joints is 99999999999"),
        ("stop.successes=32", "stop.successes is 32, more than expert.attempts=16: lower it"),
        ("first_level=2147483647", "keep them between 0 and"),
        ("unit=0", "unit is 0"),
        ("workers=-1", "workers is -1"),
        ("out=", "out is empty"),
        ("executor=ray,inline", "several values"),
        ("+new=1", "can be changed, not added"),
        ("~levels", "NAME=VALUE"),
        ("levels", "NAME=VALUE"),
        ("=3", "NAME=VALUE"),
        ("0=", "NAME=VALUE"),
        ("task=3", "group of settings"),
    ],
)
def test_compose_job_names_the_wrong_setting(override: str, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        compose_job([override])


@given(st.text(max_size=20))
@settings(deadline=None)
def test_compose_job_accepts_any_text_or_raises_one_sentence(text: str) -> None:
    sentence = ""
    try:
        compose_job([text])
    except ConfigError as error:
        sentence = str(error)
    assert "\n" not in sentence


def test_job_hash_changes_only_with_settings_that_decide_results() -> None:
    job = compose_job([])
    for same in (
        "levels=7",
        "first_level=3",
        "out=x",
        "unit=2",
        "executor=inline",
        "workers=1",
        "device=gpu",
        "budget=128000",
        "log=wandb",
        "expert.slots=3",
        "search.rounds=5",
    ):
        assert compose_job([same]).hash == job.hash, same
    for other in (
        "size=m",
        "distribution=free",
        "budget=129k",
        "expert.width=64",
        "task.frame_skip=1",
        "distribution.swap_chance=0",
    ):
        assert compose_job([other]).hash != job.hash, other


def test_job_results_contain_all_settings_but_those_without_effect() -> None:
    job = compose_job([])
    names = set(flat(plain(job)))
    assert names - set(flat(job.results)) == WITHOUT_EFFECT
    assert "stop.rule" in names - WITHOUT_EFFECT


def test_job_hash_ignores_settings_of_the_machine() -> None:
    """Tests of experts/pool and experts/search show that these two change no result."""
    machine = {setting.name for setting in every_setting() if setting.group.endswith(": machine")}
    assert machine == {name for name in WITHOUT_EFFECT if "." in name} == {"expert.slots", "search.rounds"}


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["size=l", "budget=64k"],
        ["expert.width=64", "task.physics.faithful_padding=false"],
        ["size=8-8-8-4", "distribution=vehicles"],
        ["distribution=clutter", "distribution.max_size=0.5"],
    ],
)
def test_shortest_command_reproduces_the_results(overrides: list[str]) -> None:
    job = compose_job(overrides)
    arguments = shlex.split(shortest_command(job))
    assert arguments[:2] == ["levelproof", "generate"]
    assert compose_job(arguments[2:]).results == job.results


def test_threads_compose_side_by_side() -> None:
    """Workers in threads of one process ask for the commands of their rows, and Hydra's state is global."""
    for cached in (_default, default_presets, shortest_command):
        cached.cache_clear()
    with ThreadPoolExecutor(4) as threads:
        commands = {*threads.map(lambda width: shortest_command(compose_job([f"expert.width={width}"])), range(8, 24))}
    assert len(commands) == 16


def test_shortest_command_names_presets() -> None:
    job = compose_job(["size=m", "distribution=clutter", "budget=5k"])
    assert shortest_command(job) == "levelproof generate size=m budget=5k distribution=clutter"
    spelled = [f"distribution.{key}={value}" for key, value in dataclasses.asdict(job.distribution).items()]
    assert shortest_command(compose_job(["size=m", "budget=5k", *spelled])) == shortest_command(job)


@pytest.mark.parametrize("folder", FOLDERS)
def test_presets_load_as_hydra_composes_them(folder: str) -> None:
    for name in presets()[folder]:
        job = compose_job([f"{folder}={name}", "budget=1M"])
        assert shortest_command(job).split()[4:] == (
            [f"{folder}={name}"] if name != default_presets()[folder] else []
        ), shortest_command(job)


def test_default_distribution_equals_the_kinetix_preset() -> None:
    assert compose_job([]).distribution == distributions()["kinetix"] == Distribution()


def test_distribution_presets_differ_and_repeat_no_default() -> None:
    presets = distributions()
    assert len(set(presets.values())) == len(presets) >= 5
    default = dataclasses.asdict(Distribution())
    for name in presets:
        written = OmegaConf.to_container(OmegaConf.load(str(files("levelproof.configs") / f"distribution/{name}.yaml")))
        assert isinstance(written, dict)
        assert all(value != default[str(key)] for key, value in written.items()), name


def test_name_and_hash_identifies_a_distribution() -> None:
    job = compose_job(["distribution=clutter", "size=m", "budget=5k"])
    name, digest = name_and_hash(job.distribution)
    assert name == "clutter"
    assert name_and_hash(compose_job(["distribution=clutter", "size=l"]).distribution) == (name, digest)
    other = compose_job(["distribution=clutter", "distribution.max_size=0.5"]).distribution
    assert name_and_hash(other)[0] is None
    assert name_and_hash(other)[1] != digest


def test_levels_per_unit_depend_on_the_size() -> None:
    units = {
        size: compose_job([f"size={size}"]).levels_per_unit
        for size in ("s", "m", "l", "6-2-1-1", "8-8-8-4", "24-24-9-9")
    }
    assert units == {"s": 32, "m": 16, "l": 8, "6-2-1-1": 16, "8-8-8-4": 8, "24-24-9-9": 4}
    assert compose_job(["size=l", "unit=3"]).levels_per_unit == 3


def test_compose_job_rejects_a_distribution_whose_actuators_do_not_fit_the_size() -> None:
    with pytest.raises(ConfigError, match="size is 5-5-2-0: it has no room for the actuators"):
        compose_job(["size=5-5-2-0", "distribution=thrusters"])
    assert compose_job(["size=5-5-2-0", "distribution=vehicles"]).size == "5-5-2-0"


def test_jobs_that_train_nothing_take_any_budget() -> None:
    for kind in GrowConfig, ImportConfig:
        assert kind(budget="1k", level_files="elsewhere").env_steps == 1000
        with pytest.raises(ConfigError, match="budget is '0'"):
            kind(budget="0", level_files="elsewhere")
