"""A split opened for writing: its folder, its lock, its configuration, and what dead attempts left behind."""

import json
import os
import shlex
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from configs.schema import JobConfig
from pipeline.errors import UserError
from pipeline.jobs.schedule import runs
from pipeline.store.layout import EXPERTS, JOB, MANIFEST, SHARDS, split_path
from pipeline.store.locks import Locked, nobody_commits, only_writer, require_locks
from pipeline.store.manifest import Manifest, differences, read_manifest, told


@contextmanager
def writing(job: JobConfig, say: Callable[[str], None]) -> Iterator[tuple[Path, Manifest]]:
    """The job's split, locked, cleaned, and of this configuration; with what is committed.

    Args:
        job: whose split.
        say: told what people should know meanwhile, in sentences.

    Raises:
        UserError: it cannot be written or locked, is being written, or was made with another configuration.
        Failure: a fragment is damaged.
    """
    split = split_path(job.out, job.budget, job.size)
    _make_writable(split)
    try:
        with only_writer(split):
            require_locks(split)
            manifest = clean(split, say)
            require_same(manifest, job)
            yield split, manifest
    except Locked:
        raise UserError(
            f"Another `levelproof generate` is writing to {split}: wait for it, or stop it first."
        ) from None


def require_same(manifest: Manifest, job: JobConfig) -> None:
    """Refuse to mix configurations in one split.

    Raises:
        UserError: the split was made with another one; the message names each setting that differs.
    """
    if manifest.config_hash in (None, job.hash):
        return
    changes = told(differences(manifest.config or {}, job.results))
    raise UserError(
        f"The split {manifest.split} was made with another configuration ({changes}): "
        "use the same settings, or another folder with out=NAME."
    )


def clean(split: Path, say: Callable[[str], None]) -> Manifest:
    """Remove shards and experts that no fragment names and half-written files; what is committed stays.

    Done while nobody commits: a worker of a killed run may still be about to name its shard.
    """
    with nobody_commits(split, say):
        manifest = read_manifest(split)
        for path in (split / SHARDS).glob("*.zarr"):
            if f"{SHARDS}/{path.name}" not in manifest.shards:
                shutil.rmtree(path)
        for path in (split / EXPERTS).glob("*"):
            if f"{EXPERTS}/{path.name}" not in manifest.experts:
                shutil.rmtree(path)
        for path in [*(split / MANIFEST).glob(".*"), *split.glob(f".{JOB}.*")]:
            path.unlink()
    return manifest


def note_job(split: Path, job: JobConfig, command: Sequence[str], wanted: Sequence[int]) -> None:
    """Write down what this command wants, for `levelproof status`."""
    note = {
        "command": shlex.join(command),
        "level_ids": runs(wanted),
        "config_hash": job.hash,
    }
    temporary = split / f".{JOB}.{os.getpid()}"
    temporary.write_text(json.dumps(note, indent=2) + "\n")
    temporary.replace(split / JOB)


def _make_writable(split: Path) -> None:
    """Make the folder and prove that files can be made in it."""
    try:
        split.mkdir(parents=True, exist_ok=True)
        probe = split / f".{JOB}.{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise UserError(f"Cannot write to {split} ({reason}): choose another folder with out=NAME.") from None
