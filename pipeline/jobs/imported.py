"""The job of `levelproof import`: replay another program's trajectories here, and store them as a split."""

import shlex
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from levelproof.configs.compose import compose_job
from levelproof.configs.schema import ImportConfig
from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.labels import WITNESSED
from levelproof.experts.pool.run import UnitResult
from levelproof.experts.steps import EnvSteps
from levelproof.experts.verdict.given import label_given
from levelproof.levelgen.batching import LANES, take
from levelproof.levelgen.level import name_of
from levelproof.pipeline.errors import Exit, Failure, UserError
from levelproof.pipeline.jobs.schedule import WorkUnit
from levelproof.pipeline.jobs.seal import sealing
from levelproof.pipeline.jobs.unit import commit
from levelproof.pipeline.read.kinetix.folder import Folder, open_folder, read_trajectories
from levelproof.pipeline.read.kinetix.records import dtype_of
from levelproof.pipeline.read.kinetix.zarr2 import FormatError, StoredArray
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.stopping import stoppable
from levelproof.pipeline.store.job_note import note_job
from levelproof.pipeline.store.layout import ids_of, split_path
from levelproof.pipeline.store.manifest import Manifest, read_manifest
from levelproof.pipeline.store.origins import Origin, RecordPlace, can_be_noted
from levelproof.pipeline.store.progress_bar import ProgressBar, say
from levelproof.pipeline.store.remote import require_folder
from levelproof.pipeline.store.runs import runs, within
from levelproof.pipeline.store.seed.file import is_seed
from levelproof.pipeline.store.split import writing
from levelproof.pipeline.urls import quoted
from levelproof.pipeline.words import many

UNIT_BYTES = 2**28  # bytes of a unit's records in the reference's format; memory holds a few copies
REPORTED = 3  # maximum number of skipped records that are reported one by one


class UnitOfRows(NamedTuple):
    """Rows of an array that are committed together."""

    array: StoredArray
    first: int  # index of its first row
    unit: WorkUnit  # the ids of its rows, including those that will be skipped


@stoppable()
def import_folder(folder: Path, out: Path, console: Console) -> Exit:
    """Import the trajectories in `folder` into the split `out`, or continue an import.

    Raises:
        UserError: `folder` has no readable trajectories; `out` does not end in a budget and their size; or another
            command writes to `out`, or made it, or imported it from another folder.
        Failure: a chunk is damaged, or a write failed; committed units stay.
    """
    require_folder(folder, "import it")
    if not can_be_noted(str(folder.absolute())):
        raise UserError(f"Cannot import {folder}: its name has characters that terminals cannot show, so rename it.")
    try:
        source = open_folder(folder.expanduser().absolute())
    except FormatError as error:
        raise UserError(f"Cannot import {folder}: {error}.") from None
    names = [*(array.path.name for array in source.arrays), str(out)]  # in the columns `file` and `command`
    if wrong := [name for name in names if not can_be_noted(name)]:
        raise UserError(
            f"Cannot import {folder}: the name {wrong[0]!r} has characters that terminals cannot show, so rename it."
        )
    job = _as_stored(_job(source, out))
    command = ["levelproof", "import", str(source.path), "-o", str(out)]
    prepare_jax()
    with writing(job, partial(say, console)) as (split, manifest):
        parts = list(_parts(source))
        there = manifest.level_ids  # once: to join millions of ids takes half a second
        left = [part for part in parts if not len(within(there, part.unit.level_ids[0], part.unit.level_ids[-1]))]
        _require_same_folder(source, parts, split)
        note_job(split, job, command, [(0, source.rows - 1)])
        done = len(parts) - len(left)
        already = f", {done} of {len(parts)} units are already there" if done else ""
        say(console, f"{many(source.rows, 'trajectory')} of size {job.size} into {split}{already}")
        skipped: Counter[str] = Counter()  # number of records by reason
        firsts = [*(part.unit.level_ids[0] for part in left[1:]), None]  # first level id after each unit
        try:
            with (
                sealing(split, manifest.counting, partial(say, console)) as sealer,
                ProgressBar("units of trajectories", len(left), console) as bar,
            ):
                for part, first in zip(left, firsts, strict=False):
                    reported = sum(skipped.values())
                    wrong = _import(job, split, source, part, shlex.join(command), console, reported)
                    skipped.update(wrong)
                    sealer.committed(part.unit.name, len(part.unit.level_ids) - len(wrong))
                    sealer.advance(first)
                    bar.advance(1)
        except KeyboardInterrupt:
            say(console, "Stopped: committed units stay; run the same command to continue.")
            raise
        except FormatError as error:
            raise Failure(f"Cannot continue with {folder}: {error}; fix it, then run the same command.") from None
        manifest = read_manifest(split, ["label"])
        note_job(split, job, command, runs(manifest.level_ids))
        _closing(source, split, manifest)
    return Exit.DONE


def _job(folder: Folder, out: Path) -> ImportConfig:
    """Return the job that imports a folder; raise UserError if `out` does not end in a budget and the right size."""
    size, absolute = name_of(folder.size), out.expanduser().absolute()
    parent = out.parent.parent if len(out.parts) > 1 else absolute.parent.parent
    example = f"name the split by its budget and size, as in -o data/1M/{size}"
    if absolute.name != size:
        raise UserError(f"{folder.path} has levels of size {size}, but the split is named {out}: {example}.")
    try:
        return ImportConfig(size=size, budget=absolute.parent.name, out=str(parent), level_files=str(folder.path))
    except ValueError as error:
        reason = str(error).rstrip(".")
        raise UserError(
            f"Cannot make the split {out} ({reason}): {example}, with the budget of the imported experts."
        ) from None


def _as_stored(job: ImportConfig) -> ImportConfig:
    """Return the job with the density of its split, which `seal --density` may have changed since the import began."""
    split = split_path(job.out, job.budget, job.size)
    fragments = [] if is_seed(split) else read_manifest(split, []).fragments
    stored = {density for fragment in fragments for density in fragment.densities}
    if not stored or job.stored in stored:
        return job
    known = compose_job(min(stored).split())
    return replace(job, density=known.density, key_every=known.key_every)


def _parts(folder: Folder) -> Iterator[UnitOfRows]:
    """Yield the units of all trajectories; their ids count them from 0 over all arrays."""
    record = RECORD_STEPS * dtype_of(folder.size).itemsize
    rows, first_id = max(UNIT_BYTES // record // LANES * LANES, LANES), 0
    for array in folder.arrays:
        for first in range(0, array.rows, rows):
            ids = range(first_id + first, first_id + min(first + rows, array.rows))
            yield UnitOfRows(array, first, WorkUnit(ids))
        first_id += array.rows


def _require_same_folder(folder: Folder, parts: list[UnitOfRows], split: Path) -> None:
    """Raise UserError if the split has trajectories of another folder, or of this one before it changed."""
    starts = [part.unit.level_ids[0] for part in parts]
    manifest = read_manifest(split, ["level_id", "file"], starts)
    files = {row["level_id"]: row["file"] for row in manifest.table.to_pylist()}
    for part in parts:
        wanted = _file(folder, part.array, part.first)
        if (file := files.get(part.unit.level_ids[0], wanted)) != wanted:
            raise UserError(
                f"{split} was imported from another folder (it has {file} instead of {wanted}): one folder makes one "
                "split, so name a new split with -o."
            )
    for last in (ids_of(fragment.path)[1] for fragment in manifest.fragments):
        part = parts[bisect_right(starts, last) - 1]
        beyond = last - part.unit.level_ids[-1]
        if beyond > 0 or (beyond < 0 and _is_usable(part, last + 1)):
            raise UserError(
                f"{folder.path} has other trajectories than when {split} was imported (that of level {last} was the "
                "last of its unit): import it elsewhere, with -o."
            )


def _is_usable(part: UnitOfRows, level_id: int) -> bool:
    """Whether a record from this id on can be imported: a sealed fragment is named after its last row, not unit."""
    first = part.first + level_id - part.unit.level_ids[0]
    try:
        wrong = read_trajectories(part.array, first, part.first + len(part.unit.level_ids)).wrong
    except FormatError as error:
        raise Failure(f"Cannot read {part.array.path}: {error}.") from None
    return not all(wrong)


def _import(
    job: ImportConfig, split: Path, folder: Folder, part: UnitOfRows, command: str, console: Console, reported: int
) -> list[str]:
    """Commit a unit without its unusable records; return the reasons for which they are unusable.

    `reported` records have been reported one by one already.
    """
    ids = part.unit.level_ids
    trajectories = read_trajectories(part.array, part.first, part.first + len(ids))
    good = np.flatnonzero([not reason for reason in trajectories.wrong])
    files = [_file(folder, part.array, part.first + i) for i in range(len(ids))]
    wrong = [(file, reason) for file, reason in zip(files, trajectories.wrong, strict=True) if reason]
    for file, reason in wrong[: max(REPORTED - reported, 0)]:
        say(console, f"Left out: {file}, {reason}.")
    if len(good):
        levels = take(trajectories.level, good)
        record, verdicts = label_given(levels, trajectories.action[..., good], job.task)
        origins = tuple(Origin("", files[i], job.size) for i in good)
        result = UnitResult(np.array(ids)[good], levels, record, verdicts, EnvSteps())
        commit(job, split, WorkUnit(ids, origins), result, command)
    return [reason for _, reason in wrong]


def _file(folder: Folder, array: StoredArray, row: int) -> str:
    return str(RecordPlace(folder.path, array.path.name, row))


def _closing(folder: Folder, split: Path, manifest: Manifest) -> None:
    """Print the split's labels, and the next command to type."""
    labels = manifest.counts(np.ones(len(manifest.level_ids), bool))
    total, reached = sum(labels.values()), sum(count for label, count in labels.items() if label in WITNESSED)
    counts = ", ".join(f"{count} {label}" for label, count in labels.items())
    left = f" {folder.rows - total} were left out." if total < folder.rows else ""
    print(f"{split}: {many(total, 'level')} of {folder.path}, {counts}.{left}")
    if total:
        print(f"{reached / total:.1%} reach the goal here.")
        print(f"Next:  levelproof inspect {quoted(split)}")
