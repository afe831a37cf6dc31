"""Experts under way on the disk, so that who takes up their levels goes on where they were: an archive a unit.

Whatever is wrong with one costs its experts' training, and nothing else.
"""

import io
import json
import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from levelproof.configs.schema import JobConfig
from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.found import nothing_found
from levelproof.experts.judge import Evaluation
from levelproof.experts.labels import Source
from levelproof.experts.paused import Paused
from levelproof.experts.slots import Pending
from levelproof.pipeline.owned import require_own
from levelproof.pipeline.store import objects
from levelproof.pipeline.store.checkpoints import begun_like, kept, require_plain, stacked_curves, unstacked
from levelproof.pipeline.store.fields import arrays_of
from levelproof.pipeline.store.files import remove, write
from levelproof.pipeline.store.layout import CHECKPOINT, CHECKPOINT_BEGUN, CHECKPOINTS, checkpoint_path, entries, ids_of
from levelproof.pipeline.store.provenance import versions
from levelproof.pipeline.store.remote import is_remote

STAMP = "stamp"  # its array: configuration and versions, under which alone the bits are the same


def save_paused(split: Path, unit: str, paused: Mapping[int, Paused], job: JobConfig) -> None:
    """Keep these experts of a unit, by level id, in place of those kept before; in one step.

    Raises:
        OSError, UserError, StoreFailure: the disk or the store refuses; those kept before stay.
    """
    rows = [paused[level_id] for level_id in sorted(paused)]
    stacked = jax.tree.map(lambda *xs: np.stack(xs), *map(_arrays, rows))
    arrays = arrays_of(stacked, "paused/") | {STAMP: _stamp(job), "level_id": np.array(sorted(paused))}
    arrays["curve"] = stacked_curves([row.expert for row in rows])
    arrays["source"] = np.array([row.found.source[0] for row in rows])
    if evaluations := [(i, of) for i, row in enumerate(rows) for of in row.evaluations]:
        arrays["evaluated"] = np.array([i for i, _ in evaluations])
        arrays |= arrays_of(jax.tree.map(lambda *xs: np.stack(xs), *(of for _, of in evaluations)), "evaluation/")
    file, path = io.BytesIO(), checkpoint_path(split, unit)
    np.savez(file, allow_pickle=False, **arrays)
    if not is_remote(split):
        path.parent.mkdir(parents=True, exist_ok=True)
    write(path, file.getvalue())


def load_paused(split: Path, level_ids: Collection[int], job: JobConfig) -> dict[int, Paused]:
    """Experts that are kept of these levels, each as far as it came."""
    wanted, found = set(level_ids), dict[int, Paused]()
    for path in _paths(split):
        first, last = ids_of(path)
        if not any(first <= level_id <= last for level_id in wanted):
            continue
        for level_id, of in _load(path, job).items():
            if level_id in wanted and (level_id not in found or _updates(of) > _updates(found[level_id])):
                found[level_id] = of
    return found


def drop_paused(split: Path, unit: str) -> None:
    """The unit is committed, and its experts are no longer under way."""
    remove(checkpoint_path(split, unit))


def prune_paused(split: Path, done: np.ndarray) -> None:
    """Remove what no level needs any more: all of its levels are done, or nobody can read which they are. While nobody
    works."""
    for path in entries(split, CHECKPOINTS, CHECKPOINT_BEGUN, os.DirEntry.is_file):
        remove(path)
    for path in _paths(split):
        try:
            needed = not np.isin(_read(path)["level_id"], done).all()
        except Exception:  # numpy and zipfile raise many kinds
            needed = False
        if not needed:
            remove(path)


def _paths(split: Path) -> Iterable[Path]:
    return sorted(entries(split, CHECKPOINTS, CHECKPOINT, os.DirEntry.is_file))


def _updates(paused: Paused) -> int:
    return int(paused.expert.begun.training.course.updates)


def _arrays(paused: Paused) -> Any:
    """What of it has the same shape for every expert."""
    expert, pending, rollouts, _, found = paused
    return expert.begun, pending, np.int64(rollouts), found._replace(source=())


def _stamp(job: JobConfig) -> np.ndarray:
    return np.array(json.dumps([job.hash, versions()], sort_keys=True))


def _load(path: Path, job: JobConfig) -> dict[int, Paused]:
    """All experts of an archive that is of this job and this program; of any other one, none."""
    try:
        arrays = _read(path)
        return dict(_experts(arrays, job)) if str(arrays[STAMP]) == str(_stamp(job)) else {}
    except Exception:  # numpy and zipfile raise many kinds
        return {}


def _read(path: Path) -> dict[str, np.ndarray]:
    """Raises ValueError and others where it is no archive as `save_paused` writes it."""
    if not is_remote(path):
        require_own(path, "remove it")
    file = io.BytesIO(objects.get(path).data if is_remote(path) else path.read_bytes())
    require_plain(file, len(file.getvalue()))
    with np.load(file, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def _experts(arrays: dict[str, np.ndarray], job: JobConfig) -> Iterator[tuple[int, Paused]]:
    """Raises ValueError or KeyError where arrays are none of such experts."""
    level_ids, of = arrays["level_id"], arrays.get("evaluated", np.zeros(0, int))
    begun = begun_like(job)
    like = begun, Pending(np.bool_(0), np.bool_(0), np.int32(0)), np.int64(0), nothing_found(1)._replace(source=())
    environments, attempts = job.expert.environments, job.expert.attempts
    flags = np.zeros((RECORD_STEPS, environments), bool)
    action = np.zeros((RECORD_STEPS, begun.training.recent.shape[1], attempts), np.int32)
    shown = Evaluation(action, flags, flags, begun.training.progress, begun.training.success)
    rows = unstacked(arrays, "paused/", like, len(level_ids))
    evaluations = unstacked(arrays, "evaluation/", shown, len(of)) if len(of) else []
    for i, (level_id, row) in enumerate(zip(level_ids.tolist(), rows, strict=True)):
        begun, pending, rollouts, found = row
        mine = [evaluations[j] for j in np.flatnonzero(of == i)]
        found = found._replace(source=[Source(str(arrays["source"][i]))])
        yield level_id, Paused(kept(begun, arrays["curve"][i]), pending, int(rollouts), mine, found)
