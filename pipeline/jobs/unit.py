"""One work unit: sample its levels, train their experts, replay every witness, write the shard, commit the fragment.

Idempotent: an attempt that dies leaves at most a mark, and a shard and experts that no fragment names. Knows nothing of
workers.
"""

import math
import shlex
import traceback
from collections.abc import Collection
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from levelproof.configs.compose import shortest_command
from levelproof.configs.schema import JobConfig
from levelproof.experts.labels import WITNESSED, Label, Verdict
from levelproof.experts.ledger import Ledger
from levelproof.experts.pool.pool import Pool
from levelproof.experts.pool.run import TrainingRun, UnitResult
from levelproof.experts.witness.witness import Record, replay, succeeds
from levelproof.levelgen.batching import take
from levelproof.levelgen.identity.content import content_hashes
from levelproof.levelgen.identity.keys import level_id_array
from levelproof.levelgen.identity.signature import signatures
from levelproof.levelgen.level import Level, size_of
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import TaskParams
from levelproof.physics.step import ENGINE_VERSION
from levelproof.pipeline.errors import Failure, StoreFailure, UserError
from levelproof.pipeline.jobs.schedule import Summary, UnitOutcome, WorkUnit
from levelproof.pipeline.read.level_files import LevelUnavailable, levels_at
from levelproof.pipeline.store.checkpoints import SourceUnseen, experts_for, save_experts
from levelproof.pipeline.store.disk import refusal
from levelproof.pipeline.store.fields import arrays_of, unlike_fields
from levelproof.pipeline.store.formats import Encoding
from levelproof.pipeline.store.layout import Attempt, new_attempt
from levelproof.pipeline.store.leases import LeaseLost
from levelproof.pipeline.store.locks import committing
from levelproof.pipeline.store.manifest import begin_fragment, write_fragment
from levelproof.pipeline.store.origins import RECORD, Origin
from levelproof.pipeline.store.paused import CheckpointUnread, drop_paused, load_paused
from levelproof.pipeline.store.provenance import device, versions
from levelproof.pipeline.store.publish import committed_levels
from levelproof.pipeline.store.scratch import written_disk
from levelproof.pipeline.store.shard import write_shard


def pool_for(job: JobConfig) -> Pool:
    """Return a pool in which a job's experts train, those of several units side by side."""
    return Pool(job.env_steps, job.procedure, job.task)


def begin_unit(job: JobConfig, split: Path, unit: WorkUnit, pool: Pool) -> TrainingRun:
    """Sample or read a unit's levels and submit to the pool those that need an expert.

    Raises:
        Failure: levels, or the experts to resume, cannot be read.
        StoreFailure: the store does not answer.
    """
    ids, ledger = level_id_array(unit.level_ids), Ledger(len(unit.level_ids))
    with ledger.timing("sampling"):
        levels = levels_at(unit.origins) if unit.origins else sample_levels(ids, size_of(job.size), job.distribution)
    paused = load_paused(split, unit.level_ids, job) if job.checkpoint else {}
    return TrainingRun(pool, levels, ids, experts_for(job, unit.level_ids), job.keep_experts, ledger, paused)


def finish_unit(job: JobConfig, split: Path, unit: WorkUnit, run: TrainingRun) -> Summary:
    """Judge and commit a unit whose levels have left the pool.

    Raises:
        Failure: a witness does not replay.
        OSError: a write failed; nothing is committed.
    """
    result = run.finish()
    assert result.ledger is not None
    with result.ledger.timing("replay"):
        check_witnesses(result, job.task)
    commit(job, split, unit, result)
    if job.checkpoint:
        drop_paused(split, unit.level_ids)
    labels = [verdict.label for verdict in result.verdicts]
    return Summary(len(labels), labels.count(Label.SOLVED), result.spent, result.ledger.total())


def failure(split: Path, unit: WorkUnit, error: Exception) -> UnitOutcome:
    """Return a failed attempt as a value, because exceptions may not survive pickling."""
    reason, fatal = "".join(traceback.format_exception(error)), ""
    if isinstance(error, (UserError, SourceUnseen, LevelUnavailable, LeaseLost, StoreFailure, CheckpointUnread)):
        fatal = str(error)
    elif isinstance(error, OSError) and (sentence := refusal(error, written_disk(split))):
        fatal = f"{sentence}."
    kind = next((kind for kind in (UserError, StoreFailure) if isinstance(error, kind)), Failure)
    return UnitOutcome(unit, reason=reason, fatal=fatal, kind=kind)


def check_witnesses(result: UnitResult, task: TaskParams) -> None:
    """Check that every witness, replayed from its level and actions, reproduces its record and reaches the goal.

    Raises:
        Failure: a witness does not reproduce its record or reach the goal.
    """
    replayed = replay(result.levels, result.record.action, task)
    wrong, reached = unlike_fields(result.record, replayed), succeeds(replayed.done, replayed.goal)
    for i, (level_id, verdict) in enumerate(zip(result.level_ids, result.verdicts, strict=True)):
        if verdict.label not in WITNESSED:
            continue
        if verdict.label == Label.TRIVIAL and result.record.action[..., i].any():
            raise Failure(f"Level {level_id} is labelled trivial, but its witness acts.")
        if i in wrong:
            raise Failure(f"The witness of level {level_id} does not replay: its {wrong[i]} differs.")
        if not reached[i]:
            raise Failure(f"The witness of level {level_id} does not reach the goal when replayed.")


def commit(job: JobConfig, split: Path, unit: WorkUnit, result: UnitResult, command: str = "") -> None:
    """Write the shard, under this attempt's own name, then the fragment that names it; skip committed levels.

    Args:
        command: reproduces all rows, if no `generate` or `regenerate` of a single row does.

    Raises:
        OSError: a write failed; nothing is committed.
    """
    while there := committed_levels(split, unit.name) & {*unit.level_ids}:
        left, result = unit.only(set(unit.level_ids) - there), _without(result, there)
        if left is None:
            return
        unit = left
    kept = [i for i, verdict in enumerate(result.verdicts) if verdict.label in WITNESSED]
    ledger = result.ledger or Ledger(len(result.level_ids))
    with committing(split) as folder:
        with ledger.timing("writing"):
            paths = new_attempt(folder, unit.name)
            rows = _rows(job, unit, result, kept, paths, folder, command)
            begin_fragment(paths)
            if result.experts:
                save_experts(paths.experts, result.experts)
            if kept:
                write_shard(
                    paths.shard,
                    [int(result.level_ids[i]) for i in kept],
                    shard_arrays(result.levels, result.record, kept),
                    Encoding(job.density, job.key_every, job.task),
                )
        for i, row in enumerate(rows):
            row["seconds"] = ledger.seconds_of(i)._asdict() if result.ledger else None
        write_fragment(paths, rows, job.hash, job.results, densities=[job.stored])


def _rows(
    job: JobConfig, unit: WorkUnit, result: UnitResult, kept: list[int], paths: Attempt, folder: Path, command: str
) -> list[dict[str, Any]]:
    """Return a unit's rows without their costs; `kept` are the indices of the levels in the shard."""
    rows = [manifest_row(job, int(i), v) for i, v in zip(result.level_ids, result.verdicts, strict=True)]
    for row, content, signature in zip(rows, content_hashes(result.levels), signatures(result.levels), strict=True):
        row |= {"content_hash": content, "signature": signature}
    for row_of_shard, i in enumerate(kept):
        rows[i] |= {"shard": str(paths.shard.relative_to(folder)), "row": row_of_shard}
    for row, origin in zip(rows, unit.origins, strict=bool(unit.origins)):
        row |= {"file": origin.file, "command": command or origin.command or _command(job, origin, row["level_id"])}
    for row in rows if result.experts else ():
        if row["level_id"] in result.experts:
            row["experts"] = str(paths.experts.relative_to(folder))
    return rows


def _without(result: UnitResult, level_ids: Collection[int]) -> UnitResult:
    """Return the result without these levels."""
    lanes = np.array([i for i, level_id in enumerate(result.level_ids.tolist()) if level_id not in level_ids], int)
    return replace(
        result,
        level_ids=result.level_ids[lanes],
        levels=take(result.levels, lanes),
        record=take(result.record, lanes),
        verdicts=[result.verdicts[i] for i in lanes],
        experts={level_id: kept for level_id, kept in result.experts.items() if level_id not in level_ids},
        ledger=result.ledger and result.ledger.only(lanes),
    )


def _command(job: JobConfig, origin: Origin, level_id: int) -> str:
    """Return the command that labels an unsampled level again: from its level file, or from its imported split."""
    if not (origin.split and RECORD.fullmatch(origin.file)):
        return f"{shortest_command(job)} {shlex.quote(f'level_files={origin.file}')}"
    _, _, settings = shortest_command(job).split(maxsplit=2)
    return f"levelproof regenerate {shlex.quote(f'manifest={origin.split}')} {settings} where='level_id = {level_id}'"


def shard_arrays(levels: Level, record: Record, kept: list[int]) -> dict[str, np.ndarray]:
    """Return all fields of the levels with these indices, by their names in the shard."""
    arrays = arrays_of(levels, "level/") | arrays_of(record, "record/")
    return {name: values[..., kept] for name, values in arrays.items()}


def manifest_row(job: JobConfig, level_id: int, verdict: Verdict) -> dict[str, Any]:
    """Return a level's row without its hashes and shard; null for numbers that the verdict lacks."""
    known = {name: _finite_or_null(value) for name, value in asdict(verdict).items()}
    return known | {
        "level_id": level_id,
        "file": None,
        "size": job.size,
        "budget": job.budget,
        "shard": None,
        "row": None,
        "experts": None,
        "config_hash": job.hash,
        "versions": versions(),
        "engine": ENGINE_VERSION,
        "device": device(),
        "seconds": None,
        "command": f"{shortest_command(job)} first_level={level_id} levels=1",
    }


def _finite_or_null(value: Any) -> Any:
    """Replace NaN and infinities, which mean that nothing was counted, by null, as in manifests."""
    if isinstance(value, list):
        return [_finite_or_null(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
