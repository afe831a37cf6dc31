"""The job of `levelproof import`: another program's trajectories, played again here, as a split."""

import shlex
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import track

from levelproof.configs.schema import ImportConfig
from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.labels import WITNESSED
from levelproof.experts.pool.run import UnitResult
from levelproof.experts.steps import EnvSteps
from levelproof.experts.verdict.given import label_given
from levelproof.levelgen.batching import LANES, take
from levelproof.levelgen.level import name_of
from levelproof.pipeline.errors import Exit, Failure, UserError
from levelproof.pipeline.jobs.progress import say
from levelproof.pipeline.jobs.schedule import WorkUnit
from levelproof.pipeline.jobs.seal import sealing
from levelproof.pipeline.jobs.unit import commit
from levelproof.pipeline.read.kinetix.folder import Folder, open_folder, read_trajectories
from levelproof.pipeline.read.kinetix.records import dtype_of
from levelproof.pipeline.read.kinetix.zarr2 import FormatError, StoredArray
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.stopping import stoppable
from levelproof.pipeline.store.job_note import note_job
from levelproof.pipeline.store.manifest import Manifest, read_manifest
from levelproof.pipeline.store.origins import Origin, RecordPlace, can_be_noted
from levelproof.pipeline.store.remote import require_folder
from levelproof.pipeline.store.runs import runs
from levelproof.pipeline.store.split import writing
from levelproof.pipeline.words import many

UNIT_BYTES = 2**28  # of the records of a unit, as the reference has them; they are in memory a few times
TOLD = 3  # records that are left out, each with its reason


class UnitOfRows(NamedTuple):
    """Rows of an array that are committed together."""

    array: StoredArray
    first: int  # row
    unit: WorkUnit  # the ids of its rows, whatever becomes of them


@stoppable()
def import_folder(folder: Path, out: Path, console: Console) -> Exit:
    """Make the split `out` of the trajectories in `folder`, or go on with it.

    Raises:
        UserError: `folder` has no trajectories that can be read, `out` is no name for a split of them, or it is
            written to, was made otherwise or of another folder.
        Failure: a chunk is damaged, or the disk refuses; what is committed stays.
    """
    require_folder(out, "import to it")
    if not can_be_noted(str(folder.absolute())):
        raise UserError(f"Cannot import {folder}: no terminal shows its name, so give it another one.")
    try:
        found = open_folder(folder.expanduser().absolute())
    except FormatError as error:
        raise UserError(f"Cannot import {folder}: {error}.") from None
    job = _job(found, out)
    command = ["levelproof", "import", str(found.path), "-o", str(out)]
    prepare_jax()
    with writing(job, partial(say, console)) as (split, manifest):
        parts = list(_parts(found))
        left = [part for part in parts if not _is_done(part, manifest)]
        _require_same_folder(found, parts, split)
        note_job(split, job, command, [(0, found.rows - 1)])
        done = len(parts) - len(left)
        there = f", {done} of {len(parts)} units are there already" if done else ""
        say(console, f"{many(found.rows, 'trajectory')} of size {job.size} into {split}{there}")
        out_of: Counter[str] = Counter()
        shown = track(left, "units of trajectories", console=console, transient=True, disable=not console.is_terminal)
        firsts = [*(part.unit.level_ids[0] for part in left[1:]), None]  # of what is to come after each
        try:
            with sealing(split, manifest.counting, partial(say, console)) as sealer:
                for part, first in zip(shown, firsts, strict=False):
                    out_of.update(_import(job, split, found, part, shlex.join(command), console, sum(out_of.values())))
                    sealer.committed(part.unit)
                    sealer.look(first)
        except KeyboardInterrupt:
            say(console, "Stopped: what is committed stays, and the same command goes on.")
            raise
        except FormatError as error:
            raise Failure(f"Cannot go on with {folder}: {error}; mend it, and the same command goes on.") from None
        manifest = read_manifest(split, ["label"])
        note_job(split, job, command, runs(manifest.level_ids))
        _closing(found, split, manifest)
    return Exit.DONE


def _job(folder: Folder, out: Path) -> ImportConfig:
    """Raises UserError where a split of these trajectories cannot be called so."""
    size, absolute = name_of(folder.size), out.expanduser().absolute()
    parent = out.parent.parent if len(out.parts) > 1 else absolute.parent.parent
    example = f"name the split so, as in -o data/1M/{size}"
    if absolute.name != size:
        raise UserError(f"{folder.path} has levels of size {size}, and the split would be {out}: {example}.")
    try:
        return ImportConfig(size=size, budget=absolute.parent.name, out=str(parent), level_files=str(folder.path))
    except ValueError as error:
        reason = str(error).rstrip(".")
        raise UserError(f"Cannot make the split {out} ({reason}): {example}, with the budget that was used.") from None


def _parts(folder: Folder) -> Iterator[UnitOfRows]:
    """All trajectories; their ids are their places, one after another."""
    record = RECORD_STEPS * dtype_of(folder.size).itemsize
    rows, first_id = max(UNIT_BYTES // record // LANES * LANES, LANES), 0
    for array in folder.arrays:
        for first in range(0, array.rows, rows):
            ids = range(first_id + first, first_id + min(first + rows, array.rows))
            yield UnitOfRows(array, first, WorkUnit(ids))
        first_id += array.rows


def _is_done(part: UnitOfRows, manifest: Manifest) -> bool:
    low, high = np.searchsorted(manifest.level_ids, [part.unit.level_ids[0], part.unit.level_ids[-1] + 1])
    return bool(low < high)


def _require_same_folder(folder: Folder, parts: list[UnitOfRows], split: Path) -> None:
    """Raises UserError where the split has other trajectories at the first places of its units."""
    rows = read_manifest(split, ["file"], [part.unit.level_ids[0] for part in parts]).table.to_pylist()
    files = {row["level_id"]: row["file"] for row in rows}
    for part in parts:
        wanted = _file(folder, part.array, part.first)
        if (file := files.get(part.unit.level_ids[0], wanted)) != wanted:
            raise UserError(f"{split} has {file} where {wanted} would be: one folder makes one split, as it is.")


def _import(
    job: ImportConfig, split: Path, folder: Folder, part: UnitOfRows, command: str, console: Console, told: int
) -> list[str]:
    """Commit a part; the reasons why some of it is left out."""
    ids = part.unit.level_ids
    found = read_trajectories(part.array, part.first, part.first + len(ids))
    good = np.flatnonzero([not what for what in found.wrong])
    files = [_file(folder, part.array, part.first + i) for i in range(len(ids))]
    wrong = [(file, what) for file, what in zip(files, found.wrong, strict=True) if what]
    for file, what in wrong[: max(TOLD - told, 0)]:
        say(console, f"Left out: {file}, {what}.")
    if len(good):
        levels = take(found.level, good)
        record, verdicts = label_given(levels, found.action[..., good], job.task)
        origins = tuple(Origin("", files[i], job.size) for i in good)
        result = UnitResult(np.array(ids)[good], levels, record, verdicts, EnvSteps())
        commit(job, split, WorkUnit(ids, origins), result, command)
    return [what for _, what in wrong]


def _file(folder: Folder, array: StoredArray, row: int) -> str:
    return str(RecordPlace(folder.path, array.path.name, row))


def _closing(folder: Folder, split: Path, manifest: Manifest) -> None:
    """What came of it, and what to type next. On stdout."""
    labels = manifest.counts(np.ones(len(manifest.level_ids), bool))
    total, reached = sum(labels.values()), sum(count for label, count in labels.items() if label in WITNESSED)
    counts = ", ".join(f"{count} {label}" for label, count in labels.items())
    left = f" {folder.rows - total} were left out." if total < folder.rows else ""
    print(f"{split}: {many(total, 'level')} of {folder.path}, {counts}.{left}")
    if total:
        print(f"{reached / total:.1%} reach the goal here.")
        print(f"Next:  levelproof inspect {shlex.quote(str(split))}")
