"""A split opened for writing: its folders, its lock and its configuration."""

import os
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from os import DirEntry
from pathlib import Path

from levelproof.configs.schema import JobConfig
from levelproof.pipeline.errors import LevelproofError, StoreFailure, UserError
from levelproof.pipeline.store.disk import explaining_writes, flush_entry, write_new
from levelproof.pipeline.store.layout import EVENTS, FOLDERS, INDEX_FILE, JOB, MANIFEST, entries, split_path
from levelproof.pipeline.store.leases import require_served
from levelproof.pipeline.store.leftovers import clean
from levelproof.pipeline.store.locks import committing, only_writer
from levelproof.pipeline.store.manifest import Manifest, changes_text, differences, write_index
from levelproof.pipeline.store.objects import require_conditions
from levelproof.pipeline.store.scratch import written_disk
from levelproof.pipeline.store.seed.file import is_seed
from levelproof.pipeline.urls import is_remote, require_known


@contextmanager
def writing(job: JobConfig, say: Callable[[str], None], split: Path | None = None) -> Iterator[tuple[Path, Manifest]]:
    """Lock and clean the job's split, and check its configuration; yield its path and manifest.

    Args:
        job: configuration to match.
        say: prints why the command waits, and which files it left in place.
        split: path (default: the job's own).

    Raises:
        UserError: it cannot be written or locked, is being written, or has another configuration or density.
        Failure: a fragment is damaged.
    """
    split = split or split_path(job.out, job.budget, job.size)
    require_known(split)
    with taken(split, say) as manifest:
        if manifest.config_hash not in (None, job.hash):
            changes = differences(manifest.config or {}, job.results)
            raise UserError(
                f"The split {split} was made with another configuration ({changes_text(changes)}): "
                "use the same settings, or another folder with out=NAME or -o."
            )
        stored = {density for fragment in manifest.fragments for density in fragment.densities}
        if stored and job.stored not in stored:
            raise UserError(
                f"The split {split} has {', '.join(sorted(stored))}, but this command sets {job.stored}: "
                "use the same, or another folder with out=NAME or -o."
            )
        yield split, manifest


@contextmanager
def taken(split: Path, say: Callable[[str], None], indexed: bool = False) -> Iterator[Manifest]:
    """Lock and clean a split; yield its manifest. Then write its index anew, if `indexed` or if it has one.

    Until then, and after a kill, the index may name fragments that are gone.

    Raises:
        UserError: it cannot be written or locked, or is being written.
        Failure: a fragment is damaged.
        LeaseLost: another command has taken the split over.
    """
    with locked(split, say):
        try:
            yield clean(split, say)
        except StoreFailure:
            raise  # to ask a store again that does not answer would take minutes
        except BaseException:
            with suppress(LevelproofError, OSError):
                _write_index(split, indexed=False)
            raise
        _write_index(split, indexed)


def _write_index(split: Path, indexed: bool) -> None:
    if indexed or entries(split, MANIFEST, INDEX_FILE, DirEntry.is_file):
        require_served(split)
        write_index(split)


@contextmanager
def locked(split: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Lock a split, so that this process alone writes to it.

    Raises:
        UserError: it cannot be written or locked, or is being written.
        Failure: a write in the block fails.
        StoreFailure, LeaseLost: its store does not answer, or another writer has taken over.
    """
    if is_seed(split):
        raise UserError(
            f"{split} has seed files, which no command changes: make a split from them with `levelproof grow`."
        )
    if is_remote(split):
        require_conditions(split / f".{JOB}.{secrets.randbits(60)}")
        with explaining_writes(written_disk(split)), only_writer(split, say):
            yield
        return
    _make_writable(split)
    _require_own_folders(split)
    with explaining_writes(split), only_writer(split, say):
        with committing(split):
            pass  # take the workers' lock once, to fail before anything trains if the file system has no locks
        yield


def _make_writable(split: Path) -> None:
    """Create the folder and check that files can be created in it."""
    try:
        missing = [path for path in (split, *split.parents) if not path.exists()]
        split.mkdir(parents=True, exist_ok=True)
        for path in missing:
            flush_entry(path.parent)  # the folder's name outlasts a loss of power, as what is committed in it does
        probe = split / f".{JOB}.{os.getpid()}"
        write_new(probe, b"")
        probe.unlink(missing_ok=True)  # another command that begins may clean it up
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise UserError(f"Cannot write to {split} ({reason}): choose another folder with out=NAME or -o.") from None


def _require_own_folders(split: Path) -> None:
    """Refuse links in place of the folders from which files are removed."""
    for path in (split / name for name in (*FOLDERS, EVENTS)):
        if path.is_symlink() or (path.exists() and not path.is_dir()):
            what = "a link" if path.is_symlink() else "not a folder"
            raise UserError(
                f"A split must contain its own folders, but {path} is {what}: put a folder in its place, "
                "or choose another one for the split with out=NAME or -o."
            )
