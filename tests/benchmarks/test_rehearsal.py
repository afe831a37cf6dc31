"""The simulated job makes every level once, whatever fails, and its seconds add up."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.rehearsal import Rehearsal, Scene, Work, rehearsed, state_bytes
from levelproof.pipeline.jobs.schedule import WorkUnit

NEVER = 1e12
SECONDS = np.random.default_rng(0).gamma(0.4, 2.0, 300)
CALM = Scene("calm", 5_000, 48, 8, lifetime=NEVER, failures=NEVER, crashes=NEVER, slow=0.0)


def test_undisturbed_job_takes_the_sum_of_its_levels() -> None:
    counts = Rehearsal(CALM, SECONDS).run()
    work = Work(SECONDS).of(WorkUnit(range(5_000)))
    assert counts.levels == 5_000
    assert counts.useful == pytest.approx(work, rel=1e-6)
    assert (counts.lost, counts.gone, counts.quarantined) == (0.0, 0, 0)
    assert work / 48 < counts.seconds < work / 48 + 90  # machines join within a minute


@pytest.mark.parametrize("scene", [
    replace(CALM, lifetime=60.0), replace(CALM, failures=60.0), replace(CALM, crashes=600.0),
    replace(CALM, slow=0.2), replace(CALM, speed=8.0, workers=6, a_machine=2),
], ids=["taken away", "die", "crash", "slow", "fast"])  # fmt: skip
def test_every_level_is_made_once_despite_failures(scene: Scene) -> None:
    counts = Rehearsal(scene, SECONDS).run()
    assert counts.levels == 5_000
    assert counts.quarantined == 0
    assert (counts.gone > 0) == (scene.lifetime < NEVER or scene.failures < NEVER)
    assert (counts.lost > 0) == (counts.gone > 0 or scene.crashes < NEVER)


def test_machine_that_leaves_with_notice_loses_less() -> None:
    noticed, silent = (Rehearsal(scene, SECONDS).run() for scene in (
        replace(CALM, lifetime=120.0), replace(CALM, failures=120.0)))  # fmt: skip
    assert noticed.lost / noticed.gone < silent.lost / silent.gone / 2


def test_work_of_a_unit_is_the_sum_of_its_levels() -> None:
    work, far = Work(SECONDS), 2**20 - 3
    for first in (0, far):
        unit = WorkUnit(range(first, first + 8))
        parts = [WorkUnit((i,)) for i in unit.level_ids]
        assert work.of(unit) == pytest.approx(sum(map(work.of, parts)))
        assert work.of(unit) == pytest.approx(work.of(WorkUnit(tuple(unit.level_ids))))


def test_scheduler_memory_does_not_grow_with_levels() -> None:
    small, large = state_bytes(replace(CALM, levels=20_000)), state_bytes(replace(CALM, levels=2_000_000))
    assert abs(large - small) < 100_000
    assert rehearsed(CALM, SECONDS)["first"] == "workers"


@pytest.mark.slow
def test_default_unit_size_keeps_ten_thousand_workers_busy() -> None:
    """With units of 32 levels of 0.25 s, workers would wait for the driver a fifth of their time."""
    scene = replace(CALM, levels=16_000_000, workers=10_000, a_machine=64)
    result = rehearsed(scene, SECONDS * (0.25 / SECONDS.mean()))
    assert result["busy"] >= 0.85
    assert result["driver"] < 0.5
    assert result["levels_per_unit"] > 80
