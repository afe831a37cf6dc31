"""A split opened for writing: one writer, one configuration, and nothing of dead attempts left."""

import multiprocessing
from pathlib import Path

import pytest

from configs.schema import JobConfig
from experts.labels import Label
from pipeline.errors import Failure, UserError
from pipeline.jobs.schedule import WorkUnit
from pipeline.jobs.unit import commit
from pipeline.store.locks import committing, is_written
from pipeline.store.manifest import fragment_paths
from pipeline.store.split import clean, writing
from tests.pipeline.made import made_job, made_result


@pytest.fixture
def job(tmp_path: Path) -> JobConfig:
    return made_job(str(tmp_path / "data"))


def committed(job: JobConfig, split: Path) -> None:
    commit(job, split, WorkUnit((0, 1)), made_result([0, 1], [Label.SOLVED, Label.UNSOLVED]))


def test_the_folder_is_made_and_its_path_is_budget_and_size(tmp_path: Path, job: JobConfig) -> None:
    with writing(job, print) as (split, manifest):
        assert split == tmp_path / "data/128k/s"
        assert split.is_dir()
        assert len(manifest.level_ids) == 0


def test_what_dead_attempts_left_is_removed_and_what_is_committed_stays(job: JobConfig) -> None:
    with writing(job, print) as (split, _):
        committed(job, split)
        kept = {path.name for path in (split / "shards").iterdir()}
        (split / "shards/000000000000-000000000001-dead.zarr/dyn32").mkdir(parents=True)
        (split / "manifest/.000000000002-000000000003.parquet.99").touch()
    with writing(job, print) as (split, manifest):
        assert {path.name for path in (split / "shards").iterdir()} == kept
        assert [path.name for path in (split / "manifest").iterdir()] == [path.name for path in fragment_paths(split)]
        assert manifest.level_ids.tolist() == [0, 1]


def test_a_damaged_fragment_stops_the_cleaning(job: JobConfig) -> None:
    """Its shard is named by it alone, and must not be taken for a leftover."""
    with writing(job, print) as (split, _):
        committed(job, split)
    fragment_paths(split)[0].write_bytes(b"x")
    with pytest.raises(Failure, match="is damaged"), writing(job, print):
        pass
    assert len(list((split / "shards").iterdir())) == 1


def test_another_configuration_is_refused_with_every_difference(tmp_path: Path, job: JobConfig) -> None:
    with writing(job, print) as (split, _):
        committed(job, split)
    other = made_job(str(tmp_path / "data"), "expert.width=32", "task.frame_skip=3")
    with (
        pytest.raises(UserError, match=r"expert.width was 64, now 32; task.frame_skip was 2, now 3.*out=NAME"),
        writing(other, print),
    ):
        pass


def test_more_levels_are_no_other_configuration(tmp_path: Path, job: JobConfig) -> None:
    with writing(job, print) as (split, _):
        committed(job, split)
    with writing(made_job(str(tmp_path / "data"), "levels=128", "unit=7", "workers=1"), print) as (_, manifest):
        assert len(manifest.level_ids) == 2


@pytest.mark.parametrize("place", ["data", "data/128k", "data/128k/s"])
def test_a_file_in_the_way_is_named(tmp_path: Path, job: JobConfig, place: str) -> None:
    path = tmp_path / place
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    with (
        pytest.raises(UserError, match=r"Cannot write to .*/data/128k/s \(.+\): choose another folder"),
        writing(job, print),
    ):
        pass


def test_one_writer_at_a_time(job: JobConfig) -> None:
    with writing(job, print) as (split, _):
        assert is_written(split)
        with pytest.raises(UserError, match="Another `levelproof generate` is writing"), writing(job, print):
            pass
    assert not is_written(split)
    with writing(job, print):
        pass


def _commit_slowly(split: Path, held, go_on) -> None:
    with committing(split):
        held.set()
        go_on.wait()
        (split / "committed").touch()


def test_cleaning_waits_for_a_commit_under_way(tmp_path: Path) -> None:
    """A worker that outlives its killed run may be between its shard and its fragment."""
    spawn = multiprocessing.get_context("spawn")
    held, go_on = spawn.Event(), spawn.Event()
    worker = spawn.Process(target=_commit_slowly, args=(tmp_path, held, go_on))
    worker.start()
    assert held.wait(60)
    waiting = spawn.Process(target=clean, args=(tmp_path, print))
    waiting.start()
    waiting.join(1)
    assert waiting.is_alive()
    go_on.set()
    waiting.join(60)
    worker.join(60)
    assert waiting.exitcode == 0
    assert (tmp_path / "committed").exists()
