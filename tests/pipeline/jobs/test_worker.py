"""A worker's loop on real units: what it commits, what it reports, and which units a failure affects."""

import errno
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from levelproof.configs.schema import JobConfig
from levelproof.experts.labels import WITNESSED
from levelproof.experts.pool import pool as pool_module
from levelproof.experts.search.config import SearchConfig
from levelproof.pipeline.jobs import worker as worker_module
from levelproof.pipeline.jobs.schedule import Order, Round, UnitOutcome, WorkUnit
from levelproof.pipeline.jobs.worker import Worker
from levelproof.pipeline.store.layout import checkpoint_path
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.store.paused import load_paused
from levelproof.pipeline.store.shard import Shard
from tests.pipeline.made import assert_same, lasting, made_job

UNITS = [WorkUnit((0, 1, 2)), WorkUnit((3,)), WorkUnit((4, 5))]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def job() -> JobConfig:
    # Searches that soon end: their limits are in no program
    return made_job("data", "budget=5k", "search.env_steps=65_536", "search.variations=16_384")


def outcomes(worker: Worker, units: list[WorkUnit]) -> dict[WorkUnit, UnitOutcome]:
    """Order these units at once, work until all have ended, and return their outcomes."""
    ended: dict[WorkUnit, UnitOutcome] = {}
    round = worker.work(Order(units), 0.1)
    while True:
        ended |= {outcome.unit: outcome for outcome in round.outcomes}
        if not round.totals:
            return ended
        round = worker.work(Order([]), 0.1)


def failing(work: Any, error: Exception, unit: WorkUnit | None = None, after: int = 0) -> Any:
    """Wrap the function `work` so that it raises `error` for this unit, or in every call after the first `after`."""
    calls: list[int] = []

    def maybe(*args: Any) -> Any:
        calls.append(1)
        if unit in args if unit else len(calls) > after:
            raise error
        return work(*args)

    return maybe


def test_worker_commits_a_row_for_every_level(tmp_path: Path, job: JobConfig) -> None:
    worker = Worker(job, tmp_path)
    worker.compiling = 1e4  # s, before the first unit
    rounds = [worker.work(Order(UNITS), 0.0)]
    while rounds[-1].totals:
        rounds.append(worker.work(Order([]), 0.1))
    ended = [outcome for round in rounds for outcome in round.outcomes]
    assert {outcome.unit for outcome in ended} == set(UNITS)
    summaries = [outcome.summary for outcome in ended if outcome.summary]
    manifest = read_manifest(tmp_path)
    assert manifest.level_ids.tolist() == list(range(6))
    assert sum(summary.levels for summary in summaries) == 6
    assert sum(summary.solved for summary in summaries) == manifest.labels.tolist().count("solved")
    columns = {"searched": "search_steps", "trained": "env_steps", "evaluated": "evaluation_steps"}
    for spent, column in columns.items():
        total = sum(manifest.table[column].to_pylist())
        assert sum(getattr(summary.spent, spent) for summary in summaries) == total > 0
    for row in manifest.table.to_pylist():
        assert (row["label"] in WITNESSED) == (row["shard"] is not None)
        if row["shard"]:
            assert Shard(tmp_path / row["shard"]).level_ids[row["row"]] == row["level_id"]
    costs = [row["seconds"] for row in manifest.table.to_pylist()]
    for stage in ("sampling", "training", "evaluation", "replay"):  # not writing, which ends after the row is written
        assert sum(getattr(summary.seconds, stage) for summary in summaries) == pytest.approx(
            sum(cost[stage] for cost in costs), rel=1e-4
        )
    assert 9_999 < sum(cost["compiling"] for cost in costs) < 2e4  # rows hold float32
    for row, cost in zip(manifest.table.to_pylist(), costs, strict=True):
        assert min(cost.values()) >= 0 < min(cost["sampling"], cost["replay"], cost["writing"])
        assert (cost["training"] > 0) == (row["env_steps"] > 0)
        assert (cost["evaluation"] > 0) == (row["evaluation_steps"] > 0)
        assert (cost["search"] > 0) == (row["search_steps"] > 0)
    for unit in UNITS:
        totals = [round.totals[unit] for round in rounds if unit in round.totals]
        assert totals == sorted(totals)
    assert [round.wants for round in rounds[-1:]] == [Worker(job, tmp_path).work(Order([]), 0.0).wants]


def test_unit_has_the_same_rows_and_bits_beside_others_and_alone(tmp_path: Path, job: JobConfig) -> None:
    for name, units in ("beside", UNITS), ("alone", UNITS[:1]):
        (tmp_path / name).mkdir()
        assert all(outcome.summary for outcome in outcomes(Worker(job, tmp_path / name), units).values())
    ids = len(UNITS[0].level_ids)
    assert repr(lasting(tmp_path / "beside")[:ids]) == repr(lasting(tmp_path / "alone"))
    beside, alone = (read_manifest(tmp_path / name).table.to_pylist()[:ids] for name in ("beside", "alone"))
    for one, two in zip(beside, alone, strict=True):
        if one["shard"]:
            a = Shard(tmp_path / "beside" / one["shard"]).read([one["row"]])
            b = Shard(tmp_path / "alone" / two["shard"]).read([two["row"]])
            assert_same(a, b)


def test_other_worker_makes_returned_and_undecided_levels_to_the_same_bits(tmp_path: Path, job: JobConfig) -> None:
    job = replace(job, search=SearchConfig(env_steps=0))
    unit = WorkUnit(range(16))
    (tmp_path / "cut").mkdir()
    (tmp_path / "alone").mkdir()
    outcomes(Worker(job, tmp_path / "alone"), [unit])
    worker, other = Worker(job, tmp_path / "cut"), Worker(job, tmp_path / "cut")
    round = worker.work(Order([unit]), 0.0)
    while not round.spare:
        round = worker.work(Order([]), 0.01)
    round = worker.work(Order([], give=round.spare - 1), 0.0)
    ((before, kept, back),) = round.cuts
    assert (before, round.spare) == (unit, 1)
    assert kept
    assert back
    assert sorted([*kept.level_ids, *back.level_ids]) == list(unit.level_ids)
    while sum(progress[1] for progress in round.totals.values()) < len(kept.level_ids) - 1:
        round = worker.work(Order([]), 0.01)
    worker.stopping = True
    round = worker.work(Order([]), 60.0)
    assert round.leaves
    assert not [outcome.reason for outcome in round.outcomes if outcome.reason]
    ((_, done, rest),) = round.cuts
    assert read_manifest(tmp_path / "cut").level_ids.tolist() == list(done.level_ids if done else ())
    outcomes(other, [part for part in (back, rest) if part])
    assert repr(lasting(tmp_path / "alone")) == repr(lasting(tmp_path / "cut"))


def test_other_worker_makes_levels_that_wait_for_their_search_to_the_same_bits(tmp_path: Path, job: JobConfig) -> None:
    unit = WorkUnit(range(16))
    for name in ("cut", "alone"):
        (tmp_path / name).mkdir()
    outcomes(Worker(job, tmp_path / "alone"), [unit])
    worker = Worker(job, tmp_path / "cut")
    spare = worker.work(Order([unit]), 0.0).spare
    assert spare > 4
    round = worker.work(Order([], give=spare // 2), 0.0)
    ((before, kept, back),) = round.cuts
    assert back
    assert (before, len(back.level_ids), round.spare) == (unit, spare // 2, spare - spare // 2)
    assert outcomes(worker, []).keys() == {kept}
    assert not worker.work(Order([]), 0.0).spare
    outcomes(Worker(job, tmp_path / "cut"), [back])
    assert repr(lasting(tmp_path / "alone")) == repr(lasting(tmp_path / "cut"))


def test_worker_resumes_experts_that_another_saved(tmp_path: Path, job: JobConfig) -> None:
    job = replace(job, search=SearchConfig(env_steps=0), checkpoint="1h")
    unit = WorkUnit(range(8))
    for name in ("alone", "kept"):
        (tmp_path / name).mkdir()
    (alone,) = outcomes(Worker(job, tmp_path / "alone"), [unit]).values()
    worker = Worker(job, tmp_path / "kept")
    round = worker.work(Order([unit]), 0.0)
    while not round.totals[unit][0]:
        round = worker.work(Order([]), 0.01)
    worker.stopping = True
    round = worker.work(Order([]), 60.0)
    (path,) = (tmp_path / "kept/checkpoints").iterdir()
    kept = load_paused(tmp_path / "kept", unit.level_ids, job)
    steps = sum(int(paused.expert.begun.training.progress.env_steps) for paused in kept.values())
    assert steps
    assert load_paused(tmp_path / "kept", unit.level_ids, replace(job, budget="8k")) == {}
    rest = round.cuts[-1].back
    assert rest
    (later,) = outcomes(Worker(job, tmp_path / "kept"), [rest]).values()
    one, two = ([row | {"row": 0} for row in lasting(tmp_path / name)] for name in ("alone", "kept"))
    assert repr(one) == repr(two)
    assert alone.summary
    assert later.summary
    decided = sum(row["env_steps"] for row in two if row["level_id"] not in rest.level_ids)
    assert later.summary.spent.trained == alone.summary.spent.trained - decided - steps
    assert not path.exists()


def test_worker_reports_experts_that_it_cannot_save(
    tmp_path: Path, job: JobConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise OSError(errno.EACCES, "Permission denied", "checkpoints")

    monkeypatch.setattr(worker_module, "save_paused", fail)
    worker, unit = Worker(replace(job, search=SearchConfig(env_steps=0), checkpoint="1h"), tmp_path), WorkUnit(range(8))
    round = worker.work(Order([unit]), 0.0)
    while not round.totals[unit][0]:
        assert not round.unsaved
        round = worker.work(Order([]), 0.01)
    worker.stopping = True
    assert worker.work(Order([]), 60.0).unsaved == "[Errno 13] Permission denied: 'checkpoints'"


@pytest.mark.parametrize("mode", [0o600, 0o666])
def test_unreadable_checkpoint_is_fatal(tmp_path: Path, job: JobConfig, mode: int) -> None:
    path = checkpoint_path(tmp_path, UNITS[0].name)
    path.parent.mkdir()
    path.write_bytes(b"levelproof checkpoint 2 of another format\n")
    path.chmod(mode)
    (outcome,) = outcomes(Worker(replace(job, checkpoint="1h"), tmp_path), UNITS[:1]).values()
    assert outcome.fatal.startswith(f"The checkpoint {path} cannot be read (")
    assert path.exists()


@pytest.mark.parametrize("phase", ["begin_unit", "finish_unit"])
def test_failing_unit_fails_alone(tmp_path: Path, job: JobConfig, monkeypatch: pytest.MonkeyPatch, phase: str) -> None:
    works = getattr(worker_module, phase)
    monkeypatch.setattr(worker_module, phase, failing(works, ValueError("of this one"), UNITS[1]))
    results = outcomes(Worker(job, tmp_path), UNITS)
    assert {unit for unit in UNITS if results[unit].summary} == {UNITS[0], UNITS[2]}
    assert results[UNITS[1]].reason.startswith("Traceback")
    assert results[UNITS[1]].reason.endswith("ValueError: of this one\n")
    assert not results[UNITS[1]].fatal
    assert read_manifest(tmp_path).level_ids.tolist() == [0, 1, 2, 4, 5]


def test_full_disk_is_fatal(tmp_path: Path, job: JobConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(worker_module, "finish_unit", failing(None, full))
    results = outcomes(Worker(job, tmp_path), UNITS[1:2])
    assert results[UNITS[1]].fatal.startswith(f"Cannot write to {tmp_path}, because the disk is full")


def test_failing_step_fails_running_units_but_no_later_one(
    tmp_path: Path, job: JobConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    advance, worker = pool_module.advance, Worker(job, tmp_path)
    monkeypatch.setattr(pool_module, "advance", failing(advance, MemoryError("no room on the device"), after=2))
    results = outcomes(worker, UNITS)
    assert results.keys() == set(UNITS)
    assert all(outcome.reason.endswith("MemoryError: no room on the device\n") for outcome in results.values())
    assert not list(tmp_path.rglob("*.parquet"))
    monkeypatch.setattr(pool_module, "advance", advance)
    assert outcomes(worker, UNITS[1:2])[UNITS[1]].summary
    assert read_manifest(tmp_path).level_ids.tolist() == [3]


def test_worker_without_units_reports_an_empty_round(tmp_path: Path, job: JobConfig) -> None:
    nothing = Worker(job, tmp_path).work(Order([]), 60.0)
    assert nothing == Round([], {}, nothing.wants)
    assert nothing.wants > 0
