"""One work unit on real levels: the check of its witnesses, and its commit."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest

from benchmarks.alone import label
from levelproof.configs.schema import JobConfig
from levelproof.experts.labels import Label
from levelproof.experts.pool.run import UnitResult
from levelproof.experts.witness.witness import Record, replay
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.jobs.schedule import WorkUnit
from levelproof.pipeline.jobs.unit import check_witnesses, commit
from levelproof.pipeline.store.fields import arrays_of, same_bits, tree_of
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.store.shard import Shard
from tests.pipeline.made import made_job, made_result

UNIT = WorkUnit((0, 1, 2, 3))


@pytest.fixture(scope="module")
def job() -> JobConfig:
    return made_job("data", "budget=5k")


@pytest.fixture(scope="module")
def result(job: JobConfig) -> UnitResult:
    """Real levels, experts and witnesses."""
    ids = np.array(UNIT.level_ids, np.int32)
    levels = sample_levels(ids, SIZES[job.size], job.distribution)
    result = label(levels, ids, job.env_steps, job.procedure, job.task)
    assert Label.SOLVED in [verdict.label for verdict in result.verdicts], "the tests need a solved level"
    return result


def solved_index(result: UnitResult) -> int:
    return [verdict.label for verdict in result.verdicts].index(Label.SOLVED)


def test_check_witnesses_accepts_real_witnesses(job: JobConfig, result: UnitResult) -> None:
    check_witnesses(result, job.task)


@pytest.mark.parametrize("name", ["reward", "last_distance", "timestep", "done"])
def test_check_witnesses_rejects_a_record_that_differs_in_one_bit(
    job: JobConfig, result: UnitResult, name: str
) -> None:
    index = solved_index(result)
    values = np.array(getattr(result.record, name))
    at = values[200:201, index : index + 1]
    at[...] = ~at if at.dtype == bool else (at.view(np.uint32) ^ 1).view(at.dtype)
    wrong = dataclasses.replace(result, record=dataclasses.replace(result.record, **{name: values}))
    with pytest.raises(
        Failure, match=f"witness of level {result.level_ids[index]} does not replay: its {name} differs"
    ):
        check_witnesses(wrong, job.task)


def test_check_witnesses_rejects_records_of_other_levels(job: JobConfig, result: UnitResult) -> None:
    turned = jax.tree.map(lambda x: np.roll(x, 1, axis=-1), result.levels)
    with pytest.raises(Failure, match="does not replay"):
        check_witnesses(dataclasses.replace(result, levels=turned), job.task)


def test_check_witnesses_rejects_a_record_that_misses_the_goal(job: JobConfig, result: UnitResult) -> None:
    """Idle actions give a record that replays; labelled solved, it fails because it misses the goal."""
    verdicts = [dataclasses.replace(verdict, label=Label.SOLVED) for verdict in result.verdicts]
    idle = replay(result.levels, np.zeros_like(result.record.action), job.task)
    with pytest.raises(Failure, match="does not reach the goal"):
        check_witnesses(dataclasses.replace(result, record=idle, verdicts=verdicts), job.task)


def test_check_witnesses_rejects_a_trivial_level_whose_witness_acts(job: JobConfig, result: UnitResult) -> None:
    called = [
        dataclasses.replace(v, label=Label.TRIVIAL if v.label is Label.SOLVED else v.label) for v in result.verdicts
    ]
    with pytest.raises(Failure, match="is labelled trivial, but its witness acts"):
        check_witnesses(dataclasses.replace(result, verdicts=called), job.task)


def test_commit_writes_every_field_of_solved_levels_to_the_shard(tmp_path: Path, job: JobConfig) -> None:
    result = made_result([4, 5, 7], [Label.UNSOLVED, Label.SOLVED, Label.SOLVED])
    commit(job, tmp_path, WorkUnit((4, 5, 7)), result)
    (name,) = read_manifest(tmp_path).shards
    shard = Shard(tmp_path / name)
    assert shard.level_ids.tolist() == [5, 7]
    stored = shard.read()
    for tree, kind, path in ((result.levels, Level, "level/"), (result.record, Record, "record/")):
        back = arrays_of(tree_of(kind, stored, path))
        assert all(same_bits(back[name], values[..., [1, 2]]).all() for name, values in arrays_of(tree).items())


def test_commit_writes_no_shard_without_solved_levels(tmp_path: Path, job: JobConfig) -> None:
    commit(job, tmp_path, WorkUnit((4,)), made_result([4], [Label.UNSOLVED]))
    manifest = read_manifest(tmp_path)
    assert manifest.labels.tolist() == ["unsolved"]
    assert not manifest.shards
    assert not (tmp_path / "shards").exists()
