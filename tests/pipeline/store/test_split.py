"""A split opened for writing: one writer, one configuration, folders of its own."""

from pathlib import Path

import pytest

from levelproof.configs.schema import JobConfig
from levelproof.experts.labels import Label
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.jobs.schedule import WorkUnit
from levelproof.pipeline.jobs.unit import commit
from levelproof.pipeline.store import split as split_module
from levelproof.pipeline.store.layout import FOLDERS
from levelproof.pipeline.store.locks import is_written
from levelproof.pipeline.store.split import writing
from tests.pipeline.made import made_job, made_result


@pytest.fixture
def job(tmp_path: Path) -> JobConfig:
    return made_job(str(tmp_path / "data"))


def committed(job: JobConfig, split: Path) -> None:
    commit(job, split, WorkUnit((0, 1)), made_result([0, 1], [Label.SOLVED, Label.UNSOLVED]))


def assert_refused(job: JobConfig, sentence: str) -> None:
    with pytest.raises(UserError, match=sentence), writing(job, print):
        pass


def test_writing_creates_the_folder_of_budget_and_size(tmp_path: Path, job: JobConfig) -> None:
    with writing(job, print) as (split, manifest):
        assert split == tmp_path / "data/128k/s"
        assert split.is_dir()
        assert len(manifest.level_ids) == 0


def test_names_of_new_folders_outlast_a_loss_of_power(
    tmp_path: Path, job: JobConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    flushed = list[Path]()
    monkeypatch.setattr(split_module, "flush_entry", flushed.append)
    for new in ({tmp_path, tmp_path / "data", tmp_path / "data/128k"}, set[Path]()):
        with writing(job, print):
            assert {*flushed} == new
            flushed.clear()


def test_writing_refuses_another_configuration_and_lists_differences(tmp_path: Path, job: JobConfig) -> None:
    with writing(job, print) as (split, _):
        committed(job, split)
    other = made_job(str(tmp_path / "data"), "expert.width=64", "task.frame_skip=3")
    assert_refused(other, r"expert.width was 32, now 64; task.frame_skip was 2, now 3.*out=NAME")


def test_writing_refuses_another_density(tmp_path: Path, job: JobConfig) -> None:
    """Otherwise a forgotten setting would give a split of two densities."""
    with writing(job, print) as (split, _):
        committed(job, split)
    words = ["density=witness", "key_every=16"]
    assert_refused(
        made_job(str(tmp_path / "data"), *words),
        "has density=full, but this command sets density=witness key_every=16: use",
    )


def test_writing_accepts_more_levels(tmp_path: Path, job: JobConfig) -> None:
    with writing(job, print) as (split, _):
        committed(job, split)
    with writing(made_job(str(tmp_path / "data"), "levels=128", "unit=7", "workers=1"), print) as (_, manifest):
        assert len(manifest.level_ids) == 2


@pytest.mark.parametrize("place", ["data", "data/128k", "data/128k/s"])
def test_writing_names_a_file_in_its_way(tmp_path: Path, job: JobConfig, place: str) -> None:
    path = tmp_path / place
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    assert_refused(job, r"Cannot write to .*/data/128k/s \(.+\): choose another folder")


def test_writing_refuses_a_second_writer(job: JobConfig) -> None:
    with writing(job, print) as (split, _):
        assert is_written(split)
        with pytest.raises(UserError, match="Another levelproof command is writing"), writing(job, print):
            pass
    assert not is_written(split)
    with writing(job, print):
        pass


@pytest.mark.parametrize("name", FOLDERS)
def test_writing_refuses_linked_folders(tmp_path: Path, job: JobConfig, name: str) -> None:
    split, elsewhere = tmp_path / "data/128k/s", tmp_path / "elsewhere"
    split.mkdir(parents=True)
    mine = elsewhere / "000000000000-000000000001-5f0c2a9b"
    mine.mkdir(parents=True)
    (split / name).symlink_to(elsewhere)
    assert_refused(job, rf"{name} is a link: put a folder in its place, .* out=NAME")
    assert mine.is_dir()
    (split / name).unlink()
    (split / name).touch()
    assert_refused(job, rf"{name} is not a folder")
