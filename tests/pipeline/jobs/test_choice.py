"""Which jobs run in the command's own process, and which on Ray."""

import pytest

from levelproof.configs.compose import compose_job
from levelproof.configs.schema import GrowConfig
from levelproof.pipeline.jobs import choice
from levelproof.pipeline.jobs.choice import most_workers, runs_here, workers_here
from tests.pipeline.made import made_job

HERE, ON_RAY = "executor=inline", "executor=ray"


@pytest.mark.parametrize(
    ("words", "levels"),
    [((), 64), (("size=m",), 32), (("size=l",), 16), (("budget=256k",), 32), (("budget=5k", "unit=1"), 64)],
)
def test_job_runs_here_up_to_a_number_of_levels(words: tuple[str, ...], levels: int) -> None:
    job = made_job("data", "executor=auto", *words)
    assert runs_here(job, levels)
    assert not runs_here(job, levels + 1)


@pytest.mark.parametrize(
    ("words", "levels", "workers"),
    [
        ((), 1000, 63),
        (("workers=48",), 1000, 48),
        (("workers=64",), 256, 16),
        (("workers=64", "unit=32"), 256, 8),
        (("size=l",), 16, 4),
        (("workers=4",), 1, 1),
    ],
)
def test_workers_of_ray_have_a_part_of_a_unit_each(words: tuple[str, ...], levels: int, workers: int) -> None:
    assert most_workers(compose_job(words), levels) == workers


def test_growing_is_judged_by_its_levels_alone() -> None:
    jobs = [GrowConfig(size="s", budget=budget, executor="auto") for budget in ("5k", "16M")]
    assert all(runs_here(job, 512) for job in jobs)
    assert not any(runs_here(job, 513) for job in jobs)


@pytest.mark.parametrize("word", ["workers=2", "device=gpu", ON_RAY])
def test_job_that_asks_for_workers_runs_on_ray(word: str) -> None:
    assert not runs_here(made_job("data", "executor=auto", word), 1)


def test_job_runs_on_the_cluster_that_the_environment_names(monkeypatch: pytest.MonkeyPatch) -> None:
    job = made_job("data", "executor=auto")
    assert runs_here(job, 1)
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:9")
    assert not runs_here(job, 1)
    assert runs_here(made_job("data", HERE), 10_000)


@pytest.mark.parametrize(
    ("words", "cores", "levels", "workers"),
    [
        ((), 32, 1000, 6),
        ((), 32, 64, 4),
        ((), 2, 1000, 2),
        ((), 32, 31, 1),
        ((), 32, 1, 1),
        (("workers=3",), 32, 1000, 3),
        (("device=gpu",), 32, 1000, 1),
    ],
)
def test_job_of_this_process_has_a_worker_for_each_core_that_it_can_fill(
    words: tuple[str, ...], cores: int, levels: int, workers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(choice, "own_cores", lambda: range(cores))
    assert workers_here(made_job("data", HERE, *words), levels) == workers
