"""Failed writes are explained, and flushes reach the drive."""

import errno
import fcntl
import os
import pickle
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from levelproof.experts.training.slots import begin as begin_experts
from levelproof.experts.verdict.judge import KeptExpert
from levelproof.experts.witness.success import no_success
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.pipeline.errors import Failure, LevelproofError, UserError
from levelproof.pipeline.jobs.schedule import WorkUnit
from levelproof.pipeline.jobs.unit import failure
from levelproof.pipeline.store.checkpoints import save_experts
from levelproof.pipeline.store.disk import NotRegular, explaining_writes, flush_entry
from levelproof.pipeline.store.fields import arrays_of
from levelproof.pipeline.store.files import write
from levelproof.pipeline.store.layout import WRITER_LOCK, data_paths, new_attempt, unit_name
from levelproof.pipeline.store.leases import LeaseLost
from levelproof.pipeline.store.locks import only_writer
from levelproof.pipeline.store.manifest import begin_fragment, fragment_paths, write_fragment
from levelproof.pipeline.store.shard import write_shard
from tests.pace import patience
from tests.pipeline.command import ROOT
from tests.pipeline.driver import commit_made
from tests.pipeline.made import honest_split, made_job, made_level, made_record

FULLFSYNC = 51  # macOS's number of F_FULLFSYNC


@pytest.fixture
def tiny(tmp_path: Path) -> Iterator[Path]:
    """Mount a real file system of 32 KiB."""
    folder = tmp_path / "tiny"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=32k", "tmpfs", str(folder)]
    if os.getuid() or subprocess.run(mount, check=False, capture_output=True, timeout=patience(1800)).returncode:
        pytest.skip("only root can make a tiny file system, and not everywhere")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True, timeout=patience(1800))


def kept_experts() -> dict[int, KeptExpert]:
    job = made_job("data", "expert.width=8", "expert.environments=24", "expert.attempts=8")
    ids = np.arange(1, dtype=np.int32)
    levels = sample_levels(ids, SIZES["s"], job.distribution)
    begun = begin_experts.eval_shape(levels, ids, no_success(len(ids)), job.expert)
    return {0: KeptExpert(jax.tree.map(lambda x: np.zeros(x.shape[1:], x.dtype), begun), [0.0])}


@pytest.mark.parametrize(
    ("code", "words"), [(errno.ENOSPC, "the disk is full: free"), (errno.EIO, "the disk reports an error")]
)
def test_explaining_writes_turns_failed_writes_into_sentences(tmp_path: Path, code: int, words: str) -> None:
    with (
        pytest.raises(
            Failure, match=f"^Cannot write to {tmp_path}, because {words}.* same command again; what is committed stays"
        ),
        explaining_writes(tmp_path),
    ):
        raise OSError(code, "refused")
    with pytest.raises(FileNotFoundError), explaining_writes(tmp_path):
        (tmp_path / "gone").read_bytes()


@pytest.mark.skipif(sys.platform != "linux", reason="needs a file that even root cannot write to")
@pytest.mark.parametrize("error", [NotRegular("a/b"), LeaseLost(Path("s3://bucket/data/128k/s")), UserError("Why.")])
def test_errors_keep_their_message_on_the_way_from_another_process(error: LevelproofError) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again)) == (type(error), str(error))


def test_explaining_writes_names_the_file_that_cannot_be_written(tmp_path: Path) -> None:
    elsewhere = Path("/proc/sys/kernel/version")
    words = f"^Cannot write to {elsewhere}, because writing is not permitted.* same command again"
    with pytest.raises(Failure, match=words), explaining_writes(tmp_path):
        elsewhere.write_bytes(b"")
    with pytest.raises(OSError, match="version") as refused:
        elsewhere.write_bytes(b"")
    assert re.match(words, failure(tmp_path, WorkUnit((0,)), refused.value).fatal)


def test_save_experts_fails_on_a_full_disk(tiny: Path) -> None:
    with pytest.raises(OSError, match="No space left") as refused:
        save_experts(new_attempt(tiny, unit_name(0, 0)).experts, kept_experts())
    assert refused.value.errno == errno.ENOSPC


def test_write_shard_fails_on_a_full_disk(tiny: Path) -> None:
    fields = arrays_of(made_level("s", 3), "level/") | arrays_of(made_record("s", 3), "record/")
    with pytest.raises(OSError, match="No space left") as refused:
        write_shard(new_attempt(tiny, unit_name(0, 0)).shard, [0, 1, 2], fields)
    assert refused.value.errno == errno.ENOSPC


def test_failed_write_leaves_nothing(tiny: Path) -> None:
    with pytest.raises(OSError, match="No space left"):
        write(tiny / "large", bytes(2**22))
    assert list(tiny.iterdir()) == []
    (tiny / "folder").mkdir()
    with pytest.raises(OSError, match="folder"):
        write(tiny / "folder", b"")
    assert [path.name for path in tiny.iterdir()] == ["folder"]


def test_write_fragment_fails_on_a_full_disk(tiny: Path) -> None:
    job, paths = made_job(), new_attempt(tiny, unit_name(0, 0))
    begin_fragment(paths)
    with pytest.raises(OSError, match="No space left"):
        (tiny / "filler").write_bytes(bytes(2**17))
    with pytest.raises(OSError, match="No space left") as refused:
        write_fragment(paths, [], job.hash, job.results)
    assert refused.value.errno == errno.ENOSPC
    assert not paths.fragment.exists()


@pytest.mark.parametrize("has_it", [True, False], ids=["supported", "unsupported"])
def test_flush_reaches_the_drive_on_macos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_it: bool) -> None:
    """Emulates on Linux what macOS has in addition."""
    flushed: dict[str, set[Path]] = {"drive": set(), "fsync": set()}
    fsync, control = os.fsync, fcntl.fcntl

    def note(how: str, descriptor: int) -> None:
        fsync(descriptor)
        flushed[how].add(Path(os.readlink(f"/proc/self/fd/{descriptor}")))

    def fcntl_of_macos(descriptor: int, command: int, *argument: Any) -> Any:
        if command != FULLFSYNC:
            return control(descriptor, command, *argument)
        if not has_it:
            raise OSError(errno.ENOTSUP, "Operation not supported")
        note("drive", descriptor)
        return 0

    monkeypatch.setattr(fcntl, "F_FULLFSYNC", FULLFSYNC, raising=False)
    monkeypatch.setattr(fcntl, "fcntl", fcntl_of_macos)
    monkeypatch.setattr(os, "fsync", partial(note, "fsync"))
    with only_writer(tmp_path, print):
        commit_made(tmp_path, WorkUnit((0, 1)))
    (fragment,), files = fragment_paths(tmp_path), [path for path in tmp_path.rglob("shards/**/*") if path.is_file()]
    wanted = {tmp_path / WRITER_LOCK, tmp_path, fragment.parent, *files, *(path.parent for path in files)}
    assert len(files) > 1
    assert flushed["drive" if has_it else "fsync"] >= wanted
    assert not flushed["fsync" if has_it else "drive"]


def test_flush_does_not_fall_back_when_the_drive_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(fcntl, "F_FULLFSYNC", FULLFSYNC, raising=False)
    monkeypatch.setattr(fcntl, "fcntl", fail)
    with pytest.raises(OSError, match="Input/output error"):
        flush_entry(tmp_path)


def test_only_to_drive_calls_fsync() -> None:
    """Any other caller of `fsync` would leave data in the drive's cache on macOS."""
    calls = {path.name for path in (ROOT / "pipeline").rglob("*.py") if "fsync(" in path.read_text()}
    assert calls == {"disk.py"}


def test_commit_flushes_shards_and_experts_before_the_fragment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    events: list[tuple[str, Path]] = []
    fsync, replace = os.fsync, os.replace

    def flush(descriptor: int) -> None:
        fsync(descriptor)
        events.append(("flushed", Path(os.readlink(f"/proc/self/fd/{descriptor}"))))

    def move(source: Path, target: Path) -> None:
        replace(source, target)
        events.append(("moved", Path(target)))

    monkeypatch.setattr(os, "fsync", flush)
    monkeypatch.setattr(os, "replace", move)
    split = honest_split(tmp_path, 16, 1, experts=True)
    (fragment,) = fragment_paths(split)
    committed = events.index(("moved", fragment))
    data = [path for folder in data_paths(split) for path in (folder, *folder.rglob("*")) if path.is_file()]
    assert {path.suffix for path in data_paths(split)} == {".zarr", ".npz"}
    assert {path for what, path in events[:committed] if what == "flushed"} >= {*data, *(x.parent for x in data)}
    assert ("flushed", fragment.parent) in events[committed:]
