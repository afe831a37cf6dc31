"""Fragments: commits are atomic, damage is detected, each level counts once."""

import io
import itertools
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rich.console import Console

from levelproof.configs.schema import JobConfig
from levelproof.experts.labels import Label
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.jobs.unit import manifest_row
from levelproof.pipeline.store import manifest as manifest_file
from levelproof.pipeline.store.columns import COLUMNS, MANIFEST_VERSION
from levelproof.pipeline.store.fragment import read_fragment
from levelproof.pipeline.store.layout import ids_of, new_attempt, unit_name
from levelproof.pipeline.store.manifest import (
    begin_fragment,
    changes_text,
    differences,
    fragment_paths,
    read_manifest,
    require_manifest,
    write_fragment,
)
from tests.pipeline.made import made_job, made_verdict


@pytest.fixture
def job() -> JobConfig:
    return made_job()


def commit(split: Path, job: JobConfig, level_ids: list[int], label: Label = Label.SOLVED) -> Path:
    attempt = new_attempt(split, unit_name(level_ids[0], level_ids[-1]))
    rows = [manifest_row(job, i, made_verdict(label)) for i in level_ids]
    rows = [row | {"shard": f"shards/{attempt.shard.name}", "row": i} for i, row in enumerate(rows)]
    rows = [row | {"content_hash": f"c1:{row['level_id']}", "signature": ["n1:a", "n1:b"]} for row in rows]
    begin_fragment(attempt)
    write_fragment(attempt, rows, job.hash, job.results)
    return attempt.fragment


def test_read_manifest_sorts_rows_and_returns_every_column(tmp_path: Path, job: JobConfig) -> None:
    commit(tmp_path, job, [16, 17], Label.UNSOLVED)
    commit(tmp_path, job, [0, 3])
    manifest = read_manifest(tmp_path)
    assert manifest.level_ids.tolist() == [0, 3, 16, 17]
    assert manifest.labels.tolist() == ["solved", "solved", "unsolved", "unsolved"]
    assert manifest.table.schema.equals(COLUMNS)
    assert (manifest.config_hash, manifest.config) == (job.hash, job.results)
    row = manifest.table.to_pylist()[1]
    assert (row["budget"], row["steps_to_goal"], row["portability"], row["env_steps"]) == ("128k", 17, 0.875, 4096)
    assert row["learning_curve"] == [None, 0.5]
    assert row["command"] == "levelproof generate size=s budget=128k first_level=3 levels=1"
    nothing = manifest.table.to_pylist()[2]
    rates = ("success_rate", "sticky_success_rate", "perturbed_success_rate")
    assert {
        nothing[name] for name in (*rates, "best_return", "steps_to_goal", "portability", "steps_to_first_success")
    } == {None}


@pytest.mark.parametrize("terminal", [True, False])
def test_read_manifest_shows_a_bar_for_many_fragments(
    tmp_path: Path, job: JobConfig, monkeypatch: pytest.MonkeyPatch, terminal: bool
) -> None:
    output = io.StringIO()
    monkeypatch.setattr(manifest_file, "MANY", 2)
    monkeypatch.setattr(manifest_file, "Console", lambda stderr: Console(file=output, force_terminal=terminal))
    commit(tmp_path, job, [0])
    assert read_manifest(tmp_path).level_ids.tolist() == [0]
    assert not output.getvalue()
    commit(tmp_path, job, [1])
    assert read_manifest(tmp_path).level_ids.tolist() == [0, 1]
    assert ("fragments" in output.getvalue()) == terminal


def test_columns_include_the_required_ones() -> None:
    asked = "level_id size budget label label_reason success_rate steps_to_goal steps_to_first_success env_steps"
    asked += " learning_curve shard row config_hash versions device"
    assert set(asked.split()) <= set(COLUMNS.names)


def test_read_manifest_counts_a_level_once(tmp_path: Path, job: JobConfig) -> None:
    commit(tmp_path, job, [0, 1, 2])
    commit(tmp_path, job, [2, 3])
    manifest = read_manifest(tmp_path)
    assert manifest.level_ids.tolist() == [0, 1, 2, 3]
    assert len(manifest.shards) == 2


def test_read_manifest_reads_only_requested_columns(tmp_path: Path, job: JobConfig) -> None:
    commit(tmp_path, job, [0])
    assert read_manifest(tmp_path, ["label"]).table.column_names == ["level_id", "label"]


def test_read_manifest_names_an_unknown_column(tmp_path: Path, job: JobConfig) -> None:
    commit(tmp_path, job, [0])
    with pytest.raises(UserError, match="There is no column 'lable': the manifest has level_id, "):
        read_manifest(tmp_path, ["lable"])


def test_read_manifest_is_empty_before_any_commit(tmp_path: Path) -> None:
    manifest = read_manifest(tmp_path)
    assert len(manifest.level_ids) == 0
    assert manifest.config is None
    with pytest.raises(UserError, match="Nothing is committed"):
        require_manifest(tmp_path)
    with pytest.raises(UserError, match="There is no split"):
        require_manifest(tmp_path / "nowhere")


def test_read_manifest_ignores_other_files(tmp_path: Path, job: JobConfig) -> None:
    """Half-written fragments, copies, what notebooks, desktops and NFS leave, folders and links."""
    path = commit(tmp_path, job, [0])
    begin_fragment(new_attempt(tmp_path, unit_name(1, 1)))
    for name in ("all.parquet", f"{path.stem} (copy).parquet", ".DS_Store", ".nfs0000000000003a1b00000002"):
        path.with_name(name).write_bytes(b"PAR1")
    for name in (".ipynb_checkpoints", f"{unit_name(2, 2)}.parquet"):
        path.with_name(name).mkdir()
    path.with_name(f"{unit_name(3, 3)}.parquet").symlink_to("nowhere")
    path.with_name(f"{unit_name(4, 4)}.parquet").symlink_to(path)
    assert fragment_paths(tmp_path) == [path]
    assert read_manifest(tmp_path).level_ids.tolist() == [0]


def test_failed_write_fragment_commits_nothing(tmp_path: Path, job: JobConfig) -> None:
    attempt = new_attempt(tmp_path, unit_name(0, 0))
    begin_fragment(attempt)
    with pytest.raises((pa.ArrowException, ValueError, TypeError)):
        write_fragment(attempt, [{"level_id": "no number"}], job.hash, job.results)
    assert list(tmp_path.rglob("*.*")) == [attempt.begun]


@pytest.mark.slow
def test_read_manifest_detects_damaged_bytes_or_is_unaffected(tmp_path: Path, job: JobConfig) -> None:
    path = commit(tmp_path, job, [0, 1])
    before, whole = read_manifest(tmp_path).table.to_pylist(), path.read_bytes()
    detected = 0
    for at in range(0, len(whole), 23):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x40]) + whole[at + 1 :])
        try:
            assert read_manifest(tmp_path).table.to_pylist() == before
        except Failure:
            detected += 1
    assert detected > len(whole) / 23 / 2


@pytest.mark.parametrize("content", [b"", b"PAR1", b"not parquet at all, but long enough to look at" * 9])
def test_read_manifest_names_an_invalid_fragment(tmp_path: Path, job: JobConfig, content: bytes) -> None:
    path = commit(tmp_path, job, [0])
    path.write_bytes(content)
    with pytest.raises(Failure, match=r"is damaged .* run `levelproof verify .* --repair` to regenerate its levels"):
        read_manifest(tmp_path)


@pytest.mark.parametrize("version", [MANIFEST_VERSION - 1, MANIFEST_VERSION + 1])
def test_read_manifest_refuses_another_version(tmp_path: Path, job: JobConfig, version: int) -> None:
    path = commit(tmp_path, job, [0])
    table = pq.read_table(path)
    metadata = {**(table.schema.metadata or {}), b"levelproof.manifest_version": str(version).encode()}
    pq.write_table(table.replace_schema_metadata(metadata), path)
    message = f"has manifest version {version}, but this program reads version {MANIFEST_VERSION}: use the levelproof"
    with pytest.raises(Failure, match=message):
        read_manifest(tmp_path)


def test_read_manifest_refuses_two_configurations(tmp_path: Path, job: JobConfig) -> None:
    commit(tmp_path, job, [0])
    commit(tmp_path, made_job("data", "expert.width=64"), [1])
    with pytest.raises(Failure, match=r"mixes the configurations.*expert.width was 32, now 64.*with their shards"):
        read_manifest(tmp_path)


def test_differences_name_old_and_new() -> None:
    changes = differences({"a": {"b": 1, "gone": 2}, "same": 0}, {"a": {"b": 3}, "same": 0, "new": 4})
    assert changes == {"a.b": (1, 3), "a.gone": (2, "absent"), "new": ("absent", 4)}
    assert changes_text({f"s{i}": (i, -i) for i in range(8)}).endswith("s5 was 5, now -5 and 2 more")


def test_unit_names_sort_as_ids() -> None:
    names = [unit_name(first, first + 1) for first in (0, 9, 10, 999_999, 10**9)]
    assert all(a < b for a, b in itertools.pairwise(names))


def test_read_manifest_opens_only_fragments_that_cover_the_levels(
    tmp_path: Path, job: JobConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = {tuple(ids): commit(tmp_path, job, list(ids)) for ids in ((0, 1, 2), (2, 5), (6, 7), (9, 20), (30,))}
    opened: list[Path] = []

    def noted(path: Path, columns: list[str], level_ids: np.ndarray, compact: bool) -> object:
        opened.append(path)
        first, last = ids_of(path)
        assert all((first <= level_ids) & (level_ids <= last))  # the others would slow down each fragment
        return read_fragment(path, columns, level_ids, compact)

    monkeypatch.setattr(manifest_file, "read_fragment", noted)
    for level_ids, rows, units in (
        ([2], [2], [(0, 1, 2), (2, 5)]),
        ([3, 12], [], [(2, 5), (9, 20)]),  # in range, but missing
        ([7, 30], [7, 30], [(6, 7), (30,)]),
        ([8, 31, -4], [], []),
        ([], [], []),
    ):
        opened.clear()
        manifest = read_manifest(tmp_path, ["label"], level_ids)
        assert manifest.level_ids.tolist() == rows
        assert sorted(opened) == sorted(paths[unit] for unit in units)
    with pytest.raises(KeyError):
        _ = manifest.shards  # not read, so unknown instead of empty
    assert require_manifest(tmp_path, [], [8]).table.num_rows == 0
