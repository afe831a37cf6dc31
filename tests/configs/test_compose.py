"""Override strings in, one typed job out; every mistake one sentence."""

import dataclasses
import shlex

import pytest
from hypothesis import given
from hypothesis import strategies as st

from configs.compose import again, compose_job, listing
from configs.convert import ConfigError, flat
from experts.config import ExpertConfig
from levelgen.sampler import Distribution
from levelgen.task import TaskParams


def test_no_overrides_make_the_small_default_dataset() -> None:
    job = compose_job([])
    assert (job.size, job.level_ids, job.env_steps, job.budget, job.out) == ("s", range(64), 128_000, "128k", "data")
    assert (job.executor, job.workers) == ("ray", 0)


def test_the_defaults_are_those_of_the_dataclasses() -> None:
    job = compose_job([])
    assert (job.distribution, job.task, job.expert) == (Distribution(), TaskParams(), ExpertConfig())


def test_overrides_reach_every_depth() -> None:
    job = compose_job(["size=m", "levels=1k", "first_level=5", "expert.learning_rate=1e-3", "task.physics.slop=0.02"])
    assert (job.size, job.level_ids) == ("m", range(5, 1005))
    assert job.expert.learning_rate == 1e-3
    assert job.task.physics.slop == 0.02


@pytest.mark.parametrize("text", ["a b", "é/x", "~/x=y", "a,b", "{x}", "$HOME", "[1]", "007", "a'b"])
def test_out_may_be_any_path(text: str) -> None:
    assert compose_job([f"out={text}"]).out == text


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("size=x", "no size x.*: choose one of l, m, s"),
        ("levels=abc", "levels is 'abc': write a whole number such as"),
        ("levels=0", "levels is '0'"),
        ("levels=1.5", "not a whole number"),
        ("budget=0", "budget is '0'"),
        ("budget=1k", "one update of an expert takes 2048 env steps"),
        ("budget=", "budget is ''"),
        ("budgt=1k", r"no setting budgt \(did you mean budget\?\)"),
        ("expert.lerning_rate=1", r"no setting expert.lerning_rate \(did you mean expert.learning_rate\?\)"),
        ("expert.width=a", "expert.width is 'a': it must be a whole number"),
        ("expert.discount=3", "expert.discount is 3.0: it must be between 0 and 1"),
        ("distribution.floor_red_chance=2", "distribution.floor_red_chance is 2.0"),
        ("distribution=foo", "no distribution foo"),
        ("executor=rai", r"did you mean ray\?"),
        ("first_level=-1", "they run from 0 to"),
        ("first_level=2147483647", "they run from 0 to"),
        ("unit=0", "unit is 0"),
        ("workers=-1", "workers is -1"),
        ("out=", "out is empty"),
        ("size=s,m", "several values"),
        ("+new=1", "can be changed, not added"),
        ("~levels", "NAME=VALUE"),
        ("levels", "NAME=VALUE"),
        ("=3", "NAME=VALUE"),
        ("0=", "NAME=VALUE"),
        ("task=3", "group of settings"),
    ],
)
def test_mistakes_are_named(override: str, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        compose_job([override])


@given(st.text(max_size=20))
def test_any_text_is_a_setting_or_refused(text: str) -> None:
    sentence = ""
    try:
        compose_job([text])
    except ConfigError as error:
        sentence = str(error)
    assert "\n" not in sentence


def test_the_hash_follows_results_and_nothing_else() -> None:
    job = compose_job([])
    for same in ("levels=7", "first_level=3", "out=x", "unit=2", "executor=inline", "workers=1", "budget=128000"):
        assert compose_job([same]).hash == job.hash, same
    for other in ("size=m", "budget=129k", "expert.width=32", "task.frame_skip=1", "distribution.swap_chance=0"):
        assert compose_job([other]).hash != job.hash, other


def test_every_setting_that_decides_results_is_hashed() -> None:
    job = compose_job([])
    names = {field.name for field in dataclasses.fields(job)}
    assert names - set(job.results) == {"levels", "first_level", "out", "unit", "executor", "workers"}


@pytest.mark.parametrize(
    "overrides", [[], ["size=l", "budget=64k"], ["expert.width=32", "task.physics.faithful_padding=false"]]
)
def test_again_makes_the_same_results(overrides: list[str]) -> None:
    job = compose_job(overrides)
    words = shlex.split(again(job))
    assert words[:2] == ["levelproof", "generate"]
    assert compose_job(words[2:]).results == job.results


def test_the_listing_can_be_typed_back() -> None:
    lines = [line.strip() for line in listing().splitlines()]
    assert compose_job(lines) == compose_job([])
    assert {line.partition("=")[0] for line in lines} > set(flat({"expert": dataclasses.asdict(ExpertConfig())}))
