"""A split opened for writing: its folders, its lock and its configuration."""

import os
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from levelproof.configs.schema import JobConfig
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.store.disk import told_of, write_new
from levelproof.pipeline.store.layout import EVENTS, FOLDERS, JOB, split_path
from levelproof.pipeline.store.leftovers import clean
from levelproof.pipeline.store.locks import committing, only_writer
from levelproof.pipeline.store.manifest import Manifest, differences, told
from levelproof.pipeline.store.objects import require_conditions
from levelproof.pipeline.store.remote import is_remote
from levelproof.pipeline.urls import require_known


@contextmanager
def writing(job: JobConfig, say: Callable[[str], None], split: Path | None = None) -> Iterator[tuple[Path, Manifest]]:
    """The job's split, locked, cleaned, and of this configuration; with what is committed. It may lie elsewhere.

    Raises:
        UserError: it cannot be written or locked, is being written, or was made with another configuration or
            density.
        Failure: a fragment is damaged.
    """
    split = split or split_path(job.out, job.budget, job.size)
    require_known(split)
    with taken(split, say) as manifest:
        if manifest.config_hash not in (None, job.hash):
            changes = told(differences(manifest.config or {}, job.results))
            raise UserError(
                f"The split {split} was made with another configuration ({changes}): "
                "use the same settings, or another folder with out=NAME."
            )
        stored = {density for fragment in manifest.fragments for density in fragment.densities}
        if stored and job.stored not in stored:
            raise UserError(
                f"The split {split} has {', '.join(sorted(stored))}, and this asks for {job.stored}: "
                "use the same, or another folder with out=NAME."
            )
        yield split, manifest


@contextmanager
def taken(split: Path, say: Callable[[str], None]) -> Iterator[Manifest]:
    """The split, locked and cleaned; with what is committed.

    Raises:
        UserError: it cannot be written or locked, or is being written.
        Failure: a fragment is damaged.
    """
    with locked(split, say):
        yield clean(split, say)


@contextmanager
def locked(split: Path, say: Callable[[str], None]) -> Iterator[None]:
    """The split for this process alone to write to.

    Raises:
        UserError: it cannot be written or locked, or is being written.
        Failure: the disk refuses later.
        StoreFailure, LeaseLost: its store does not answer, or has another writer by now.
    """
    if is_remote(split):
        require_conditions(split / f".{JOB}.{secrets.randbits(60)}")
        with only_writer(split, say):
            yield
        return
    _make_writable(split)
    _require_own_folders(split)
    with told_of(split), only_writer(split, say):
        with committing(split):
            pass  # as workers do: a file system that refuses their lock is named before anything trains
        yield


def _make_writable(split: Path) -> None:
    """Make the folder and prove that files can be made in it."""
    try:
        split.mkdir(parents=True, exist_ok=True)
        probe = split / f".{JOB}.{os.getpid()}"
        write_new(probe, b"")
        probe.unlink()
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise UserError(f"Cannot write to {split} ({reason}): choose another folder with out=NAME.") from None


def _require_own_folders(split: Path) -> None:
    """Refuse links: what is removed from a split is looked for in these folders."""
    for path in (split / name for name in (*FOLDERS, EVENTS)):
        if path.is_symlink() or (path.exists() and not path.is_dir()):
            what = "a link" if path.is_symlink() else "no folder"
            raise UserError(
                f"The folders of a split must be in it, and {path} is {what}: put a folder in its place, "
                "or choose another one for the split with out=NAME."
            )
