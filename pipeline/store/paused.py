"""Checkpoints of experts in training, from which a later process resumes them: one file per unit.

A file is one line, its head, which names the experts' levels, and a numpy archive. The head alone decides whether a
file is still needed. A file is removed when its levels are committed, or when its bytes prove damage. One that cannot
be read now (a permission, a store's time-out) stays, and a unit that needs it fails.
"""

import hashlib
import io
import json
import os
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import BadZipFile

import jax
import numpy as np

from levelproof.configs.schema import JobConfig
from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.labels import Source
from levelproof.experts.pool.found import nothing_found
from levelproof.experts.pool.paused import Paused
from levelproof.experts.training.slots import Pending
from levelproof.experts.verdict.judge import Evaluation
from levelproof.levelgen.batching import stacked
from levelproof.pipeline.errors import Failure, LevelproofError, StoreFailure
from levelproof.pipeline.owned import require_own
from levelproof.pipeline.store import objects
from levelproof.pipeline.store.checkpoints import begun_like, kept, require_plain, stacked_curves, unstacked
from levelproof.pipeline.store.fields import arrays_of
from levelproof.pipeline.store.files import remove, write
from levelproof.pipeline.store.layout import (
    CHECKPOINT,
    CHECKPOINT_BEGUN,
    CHECKPOINTS,
    checkpoint_path,
    entries,
    ids_of,
)
from levelproof.pipeline.store.leases import require_served
from levelproof.pipeline.store.provenance import device, learned_with, versions
from levelproof.pipeline.store.remote import at_once
from levelproof.pipeline.urls import as_typed, is_remote

MAGIC = b"levelproof checkpoint "  # start of a head
VERSION = 1  # of the format
MAX_HEAD = 2**20  # bytes; a level id takes 12
MALFORMED = (BadZipFile, EOFError, LookupError, ValueError, TypeError, AttributeError, RuntimeError, OverflowError)
OWN = 0o600  # mode of a file, under any umask: `require_own` refuses files that others can write to


class CheckpointUnread(Failure):
    """A checkpoint whose experts a unit needs cannot be read now."""


class _DamagedError(Exception):
    """The bytes of a checkpoint differ from what `save_paused` wrote."""


class _Head(NamedTuple):
    """The first line of a checkpoint."""

    level_ids: tuple[int, ...]
    stamp: str  # configuration, versions, device, optimiser; with others, results would differ
    start: int  # of the archive, in bytes
    sha256: str  # of the archive


def save_paused(split: Path, unit: str, paused: Mapping[int, Paused], job: JobConfig) -> None:
    """Replace a unit's checkpoint with these experts, by level id, in one step.

    Raises:
        OSError, UserError, StoreFailure: the write fails; the earlier checkpoint stays.
        LeaseLost: this process works for a writer that no longer has the split; the earlier checkpoint stays.
    """
    rows = [paused[level_id] for level_id in sorted(paused)]
    arrays = arrays_of(stacked(map(_arrays, rows)), "paused/") | {"level_id": np.array(sorted(paused))}
    arrays["curve"] = stacked_curves([row.expert for row in rows])
    arrays["source"] = np.array([row.found.source[0] for row in rows])
    if evaluations := [(i, evaluation) for i, row in enumerate(rows) for evaluation in row.evaluations]:
        indices, trees = zip(*evaluations, strict=True)
        arrays["evaluated"] = np.array(indices)
        arrays |= arrays_of(stacked(trees), "evaluation/")
    file, path = io.BytesIO(), checkpoint_path(split, unit)
    np.savez(file, allow_pickle=False, **arrays)
    archive = file.getvalue()
    head = {
        "levels": sorted(paused),
        "stamp": _stamp(job),
        "bytes": len(archive),
        "sha256": hashlib.sha256(archive).hexdigest(),
    }
    require_served(split)  # the next writer's workers save experts under the same names
    if not is_remote(split):
        path.parent.mkdir(exist_ok=True)
    write(path, MAGIC + f"{VERSION} {json.dumps(head)}\n".encode() + archive, OWN)


def load_paused(split: Path, level_ids: Collection[int], job: JobConfig) -> dict[int, Paused]:
    """Load the latest saved expert of each level, from checkpoints of this job and these versions.

    Raises:
        CheckpointUnread: a checkpoint that may hold one of them cannot be read.
        StoreFailure: the store does not answer.
    """
    wanted, experts = set(level_ids), dict[int, Paused]()
    for path in _paths_of(split, wanted):
        for level_id, expert in _load(path, wanted, job).items():
            if level_id not in experts or _updates(expert) > _updates(experts[level_id]):
                experts[level_id] = expert
    return experts


def drop_paused(split: Path, level_ids: Collection[int]) -> None:
    """Remove checkpoints of these levels, of a committed unit, under whatever unit's name they were saved.

    A checkpoint with experts of other levels, too, or that cannot be read, is left to `prune_paused`.
    """
    done = set(level_ids)
    with suppress(OSError, LevelproofError):
        for path in _paths_of(split, done):
            with suppress(OSError, LevelproofError, _DamagedError):
                if done.issuperset(_head(path).level_ids):
                    remove(path)


def prune_paused(split: Path, done: np.ndarray, say: Callable[[str], None]) -> None:
    """Remove checkpoints whose levels are all `done` (ascending ids), and damaged ones; call while no worker is active.

    Reports damaged checkpoints, and those that stay because they cannot be read, through `say`.
    """
    for path in entries(split, CHECKPOINTS, CHECKPOINT_BEGUN, os.DirEntry.is_file):
        remove(path)
    paths = _paths(split)
    for path, (why, is_over) in zip(paths, at_once(split, lambda path: _judged(path, done), paths), strict=True):
        if is_over:
            remove(path)
        if why:
            say(f"The checkpoint {as_typed(path)} {why}.")


def _judged(path: Path, done: np.ndarray) -> tuple[str, bool]:
    """Return what is wrong with a checkpoint, or an empty string, and whether to remove it."""
    first, last = ids_of(path)
    low, high = np.searchsorted(done, [first, last + 1])
    if high - low == last - first + 1:
        return "", True
    try:
        return "", bool(np.isin(_head(path).level_ids, done).all())
    except FileNotFoundError:
        return "", False
    except _DamagedError as error:
        return f"is damaged ({error}) and was removed: its experts train from the start", True
    except (OSError, LevelproofError) as error:
        return f"cannot be read ({_reason(error)}): it stays until its levels are done", False


def _paths_of(split: Path, level_ids: set[int]) -> list[Path]:
    """List the checkpoints whose names may include some of these levels."""
    spans = [(path, *ids_of(path)) for path in _paths(split)]
    return [path for path, first, last in spans if any(first <= level_id <= last for level_id in level_ids)]


def _paths(split: Path) -> list[Path]:
    return sorted(entries(split, CHECKPOINTS, CHECKPOINT, os.DirEntry.is_file))


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error).rstrip(".")


def _updates(paused: Paused) -> int:
    return int(paused.expert.begun.training.course.updates)


def _arrays(paused: Paused) -> Any:
    """Return the parts that have the same shape for every expert."""
    expert, pending, rollouts, _, findings = paused
    return expert.begun, pending, np.int64(rollouts), findings._replace(source=())


def _stamp(job: JobConfig) -> str:
    unoptimised = jax.config.values["jax_disable_most_optimizations"]  # commands leave it to the user
    return json.dumps([job.hash, versions() | learned_with(), device(), unoptimised], sort_keys=True)


def _load(path: Path, wanted: set[int], job: JobConfig) -> dict[int, Paused]:
    """Load the `wanted` experts of a checkpoint; none if it is damaged, or has another job, version or device."""
    try:
        head = _head(path)
        if head.stamp != _stamp(job) or wanted.isdisjoint(head.level_ids):
            return {}
        data = objects.get(path).data if is_remote(path) else path.read_bytes()
        return {level_id: expert for level_id, expert in _experts_in(data, path, job).items() if level_id in wanted}
    except (FileNotFoundError, _DamagedError):  # another worker has committed its unit
        return {}
    except StoreFailure:
        raise
    except (OSError, LevelproofError) as error:
        raise CheckpointUnread(
            f"The checkpoint {as_typed(path)} cannot be read ({_reason(error)}): make it readable, or remove it to "
            "train its experts from the start."
        ) from error


def _head(path: Path) -> _Head:
    """Read the head of a checkpoint, and nothing else.

    Raises:
        OSError, UserError, StoreFailure: it cannot be read, or others can write to it.
        Failure: it has another version.
        _DamagedError: it is damaged.
    """
    if is_remote(path):
        return _head_in(*objects.begin_of(path, MAX_HEAD), path)
    require_own(path, "remove it")
    with path.open("rb") as file:
        return _head_in(file.readline(MAX_HEAD), os.fstat(file.fileno()).st_size, path)


def _head_in(data: bytes, size: int, path: Path) -> _Head:
    """Parse the head of a checkpoint of `size` bytes from its first bytes. Raises as `_head`."""
    line, end, _ = data.partition(b"\n")
    first, last = ids_of(path)
    try:
        version, text = line.removeprefix(MAGIC).decode().split(maxsplit=1)
        if not (line.startswith(MAGIC) and end and version.isdecimal()):
            raise ValueError
        if int(version) != VERSION:
            raise Failure(f"it has version {int(version)}, but this levelproof reads {VERSION}")
        fields = json.loads(text)
        head = _Head(tuple(fields["levels"]), str(fields["stamp"]), len(line) + 1, str(fields["sha256"]))
        whole = head.start + int(fields["bytes"])
        if not all(type(level_id) is int and first <= level_id <= last for level_id in head.level_ids):
            raise ValueError
    except (ValueError, LookupError, TypeError, OverflowError, RecursionError):
        raise _DamagedError("its first line is invalid") from None
    if size != whole:
        raise _DamagedError("it is cut off, or too long")
    return head


def _experts_in(data: bytes, path: Path, job: JobConfig) -> dict[int, Paused]:
    """Parse all experts of a whole checkpoint. Raises as `_head_in`."""
    head = _head_in(data, len(data), path)
    archive = data[head.start :]
    if hashlib.sha256(archive).hexdigest() != head.sha256:
        raise _DamagedError("its bytes have changed")
    file = io.BytesIO(archive)
    try:
        require_plain(file, len(archive))
        with np.load(file, allow_pickle=False) as arrays:
            return dict(_experts({name: arrays[name] for name in arrays.files}, job))
    except MALFORMED as error:
        raise _DamagedError("its arrays are invalid") from error


def _experts(arrays: dict[str, np.ndarray], job: JobConfig) -> Iterator[tuple[int, Paused]]:
    """Yield experts by level id. Raises ValueError or KeyError if arrays do not fit this job."""
    level_ids, evaluated = arrays["level_id"], arrays.get("evaluated", np.zeros(0, int))
    begun = begun_like(job)
    training = begun.training
    like = begun, Pending(np.bool_(0), np.bool_(0), np.int32(0)), np.int64(0), nothing_found(1)._replace(source=())
    environments, attempts = job.expert.environments, job.expert.attempts
    flags = np.zeros((RECORD_STEPS, environments), bool)
    action = np.zeros((RECORD_STEPS, training.recent.shape[1], attempts), np.int32)
    evaluation = Evaluation(action, flags, flags, training.progress, training.success, training.course.over)
    rows = unstacked(arrays, "paused/", like, len(level_ids))
    evaluations = unstacked(arrays, "evaluation/", evaluation, len(evaluated)) if len(evaluated) else []
    for i, (level_id, row) in enumerate(zip(level_ids.tolist(), rows, strict=True)):
        begun, pending, rollouts, findings = row
        successes = [evaluations[j] for j in np.flatnonzero(evaluated == i)]
        findings = findings._replace(source=[Source(str(arrays["source"][i]))])
        yield level_id, Paused(kept(begun, arrays["curve"][i]), pending, int(rollouts), successes, findings)
