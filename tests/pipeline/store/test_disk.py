"""A disk that is full refuses every writer in the same way; what is flushed."""

import errno
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest

from levelproof.experts.judge import Kept
from levelproof.experts.slots import begin as begin_experts
from levelproof.experts.success import no_success
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.checkpoints import save_experts
from levelproof.pipeline.store.disk import told_of
from levelproof.pipeline.store.fields import arrays_of
from levelproof.pipeline.store.layout import new_attempt, unit_name
from levelproof.pipeline.store.manifest import begin_fragment, write_fragment
from levelproof.pipeline.store.shard import write_shard
from tests.pipeline.made import made_job, made_level, made_record


@pytest.fixture
def tiny(tmp_path: Path) -> Iterator[Path]:
    """A real file system with 32 KiB."""
    folder = tmp_path / "tiny"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=32k", "tmpfs", str(folder)]
    if os.getuid() or subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("only root can make a tiny file system, and not everywhere")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def kept_experts() -> dict[int, Kept]:
    job = made_job("data", "expert.width=8", "expert.environments=24", "expert.attempts=8")
    ids = np.arange(1, dtype=np.int32)
    levels = sample_levels(ids, SIZES["s"], job.distribution)
    begun = jax.eval_shape(lambda: begin_experts(levels, ids, no_success(len(ids)), job.expert))
    return {0: Kept(jax.tree.map(lambda x: np.zeros(x.shape[1:], x.dtype), begun), [0.0])}


@pytest.mark.parametrize(("code", "words"), [(errno.ENOSPC, "the disk is full: free"), (errno.EIO, "the disk fails")])
def test_what_the_disk_refuses_is_said_in_a_sentence(tmp_path: Path, code: int, words: str) -> None:
    with pytest.raises(Failure, match=f"^Cannot write to {tmp_path}, {words}.* same command again"), told_of(tmp_path):
        raise OSError(code, "refused")
    with pytest.raises(FileNotFoundError), told_of(tmp_path):
        (tmp_path / "gone").read_bytes()


@pytest.mark.slow
def test_experts_on_a_full_disk(tiny: Path) -> None:
    with pytest.raises(OSError, match="No space left") as refused:
        save_experts(new_attempt(tiny, unit_name(0, 0)).experts, kept_experts())
    assert refused.value.errno == errno.ENOSPC


def test_a_shard_on_a_full_disk(tiny: Path) -> None:
    fields = arrays_of(made_level("s", 3), "level/") | arrays_of(made_record("s", 3), "record/")
    with pytest.raises(OSError, match="No space left") as refused:
        write_shard(new_attempt(tiny, unit_name(0, 0)).shard, [0, 1, 2], fields)
    assert refused.value.errno == errno.ENOSPC


def test_a_fragment_on_a_full_disk(tiny: Path) -> None:
    job, paths = made_job(), new_attempt(tiny, unit_name(0, 0))
    begin_fragment(paths)
    with pytest.raises(OSError, match="No space left"):
        (tiny / "filler").write_bytes(bytes(2**17))
    with pytest.raises(OSError, match="No space left") as refused:
        write_fragment(paths, [], job.hash, job.results)
    assert refused.value.errno == errno.ENOSPC
    assert not paths.fragment.exists()


@pytest.mark.slow
def test_experts_are_on_the_disk_before_the_fragment_names_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flushed: set[Path] = set()
    fsync = os.fsync

    def note(descriptor: int) -> None:
        fsync(descriptor)
        flushed.add(Path(os.readlink(f"/proc/self/fd/{descriptor}")))

    monkeypatch.setattr(os, "fsync", note)
    experts = new_attempt(tmp_path, unit_name(0, 0)).experts
    save_experts(experts, kept_experts())
    assert flushed >= {tmp_path, experts.parent, experts}
