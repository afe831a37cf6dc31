"""`levelproof plan`, on a job so small that the sample is the whole job."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from levelproof.configs.schema import JobConfig
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.jobs import plan as planning
from levelproof.pipeline.jobs.address import ray_address
from levelproof.pipeline.jobs.forecast import PerWitness, Sample, forecast
from levelproof.pipeline.jobs.plan import MAX_SAMPLE, costs_of, report_lines
from tests.pipeline.command import TINY, assert_refused, here
from tests.pipeline.made import made_job


@pytest.mark.campaign
def test_plan_prints_a_forecast_and_leaves_no_file(tmp_path: Path) -> None:
    done = here(["plan", *TINY, "executor=inline", "workers=3", "--json"], tmp_path)
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert (facts["levels"], facts["workers"], facts["sample"]["levels"]) == (4, 3, 4)
    assert 0 < facts["wall"]["low"] <= facts["wall"]["expected"] <= facts["wall"]["high"]
    assert facts["solved"]["expected"] == 3.0
    assert (
        facts["bytes"]["witness"]["expected"]
        < facts["bytes"]["resume"]["expected"]
        < facts["bytes"]["full"]["expected"]
    )
    assert not list(tmp_path.iterdir())


def test_report_names_units_and_unknown_costs() -> None:
    busy = np.tile([0.5, 1.5], 100)
    some = Sample("core", 2, 60.0, 5.0, 20.0, busy, busy < 1, busy < 1, 200.0, {"full": PerWitness(10_000.0, 5)})
    lines = report_lines(made_job("data", "levels=6M"), some, forecast(some, 6_000_000, 64, 32))
    assert lines[0] == "6,000,000 levels of size s, budget 128k:"
    assert re.match(r"  wall time: +26 \(.* to .*\) hours with 64 workers$", lines[1])
    assert lines[-1].startswith("Measured on 200 of these levels, made on 2 cores here in ")
    none = replace(some, solved=busy > 9)
    assert "core-seconds per solved level: unknown" in " ".join(
        " ".join(line.split()) for line in report_lines(made_job("data"), none, forecast(none, 100, 2, 32))
    )


def test_plan_of_levels_that_cannot_be_made_fails(tmp_path: Path) -> None:
    with pytest.raises(Failure, match="No level could be made on this machine"):
        costs_of(tmp_path)


class Begun(Exception):
    """A sample would be made now."""


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[tuple[JobConfig, int, str]]:
    """Return the jobs of samples, with their levels and RAY_ADDRESS, none of which is made."""
    jobs: list[tuple[JobConfig, int, str]] = []

    def begin(job: JobConfig, *_: Any, level_ids: Sequence[int]) -> None:
        jobs.append((job, len(level_ids), ray_address()))
        raise Begun

    monkeypatch.setattr(planning, "generate", begin)
    return jobs


def test_plan_ignores_the_cluster_that_the_environment_names(begun: list, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sample lies in a temporary folder of this machine."""
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:9")
    with pytest.raises(Begun):
        planning.plan(made_job("data", "executor=auto", "levels=16"), False, Console(quiet=True))
    ((job, _, address),) = begun
    assert (job.executor, address) == ("inline", "")
    assert ray_address() == "127.0.0.1:9"


@pytest.mark.parametrize(("word", "unit"), [("unit=100k", 32), ("unit=3", 3), ("unit=null", None)])
def test_plan_samples_few_levels_whatever_the_unit(
    begun: list, word: str, unit: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(planning, "own_cores", lambda: set(range(1000)))
    for most, cores in (1000 * (unit or 32), 1000), (unit or 32, 1):
        with pytest.raises(Begun):
            planning.plan(
                made_job("data", "executor=ray", "levels=1M", f"workers={cores}", word), False, Console(quiet=True)
            )
        job, levels, _ = begun.pop()
        assert (job.unit, levels) == (unit, min(most, MAX_SAMPLE))


def test_plan_rejects_level_files(tmp_path: Path) -> None:
    done = here(["plan", "level_files=mine"], tmp_path)
    assert_refused(done, 2, "plan is for random levels")
