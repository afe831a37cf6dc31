"""The job of `levelproof generate`: what is left to do, done by workers or in this process, and said to the user."""

import shlex
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
from rich.console import Console

from levelproof.configs.schema import JobConfig
from levelproof.experts.labels import Label
from levelproof.experts.steps import EnvSteps
from levelproof.pipeline.errors import Exit, Failure
from levelproof.pipeline.jobs.events import Events, telling
from levelproof.pipeline.jobs.log import logged, require_library
from levelproof.pipeline.jobs.progress import Board, Tally, say
from levelproof.pipeline.jobs.schedule import Scheduler, UnitOutcome, WorkUnit, levels_text, schedule
from levelproof.pipeline.jobs.seal import Sealer, sealing
from levelproof.pipeline.runtime import cache_folder
from levelproof.pipeline.stopping import Stop, stoppable
from levelproof.pipeline.store import quarantine
from levelproof.pipeline.store.checkpoints import require_same_experts
from levelproof.pipeline.store.job_note import note_job
from levelproof.pipeline.store.layout import quarantine_path
from levelproof.pipeline.store.manifest import Manifest, read_manifest
from levelproof.pipeline.store.origins import Origin, require_same_levels
from levelproof.pipeline.store.paused import prune_paused
from levelproof.pipeline.store.remote import as_typed
from levelproof.pipeline.store.runs import ascending, merged, runs
from levelproof.pipeline.store.split import writing
from levelproof.pipeline.words import many


def generate(
    job: JobConfig,
    command: Sequence[str],
    console: Console,
    level_ids: Sequence[int] | None = None,
    origins: Mapping[int, Origin] | None = None,
    repaired: Path | None = None,
) -> Exit:
    """Make what is missing of the job's levels, and commit it unit by unit.

    `command` is as typed, for the hint of how to go on; `level_ids` are which levels, if not those of the job;
    `origins` say where they are, if their ids do not make them; `repaired` is the split, where they are made again.

    Raises:
        UserError, Failure: see `log.require_library`, `runtime.cache_folder`, `store.split.writing` and
            `store.checkpoints.require_same_experts`; or the disk refuses.
        KeyboardInterrupt: stopped by Ctrl-C or SIGTERM; what is committed stays.
    """
    require_library(job.log)
    cache_folder()  # where workers refuse it, Ray makes many lines of the sentence
    require_same_experts(job)
    with stoppable() as stop, writing(job, partial(say, console), repaired) as (split, manifest):
        asked = [*origins] if origins else (job.level_ids if level_ids is None else level_ids)
        wanted = ascending(np.fromiter(asked, np.int64, len(asked)))
        is_done = np.isin(manifest.level_ids, wanted)
        done = manifest.level_ids[is_done]
        require_same_levels(split, origins or {}, done)
        left = len(wanted) - len(done)
        scheduler = schedule(asked, done, left, job.levels_per_unit, job.unit is None, origins)
        quarantine.drop_notes(split, manifest.level_ids)
        prune_paused(split, manifest.level_ids, partial(say, console))
        if not repaired:
            note_job(split, job, command, merged(runs(wanted), runs(manifest.level_ids)))
        if scheduler.waiting:
            solved = manifest.counts(is_done).get(Label.SOLVED, 0)
            board = Board(Tally(len(wanted), len(done), solved), console)
            there = f", {len(done)} are there already" if len(done) else ""
            each = f"{many(len(wanted), 'level')} of size {job.size}, {job.budget} env steps each"
            board.say(f"{each}, into {as_typed(split)}{there}")
            try:
                with (
                    logged(job, split, board.say) as log,
                    board.shown(),
                    sealing(split, manifest.counting, board.say) as sealer,
                    telling(split, board, scheduler, shlex.join(command), log) as events,
                ):
                    _work(job, split, scheduler, board, sealer, events, stop)
            except KeyboardInterrupt:
                done = f"{board.tally.done:,} of {many(len(wanted), 'level')} committed"
                board.say(f"Stopped: {done}; the same command goes on.")
                raise
            manifest = read_manifest(split, ["label", "env_steps"], compact=True)
            quarantine.drop_notes(split, manifest.level_ids)
            prune_paused(split, manifest.level_ids, board.say)
            spent = _spent(manifest, np.setdiff1d(wanted, done), board.tally.spent) if board.tally.spent.shown else ""
        else:
            print(f"Nothing to do: {many(len(wanted), 'level')} there already.")
            spent = ""
        _closing(split, manifest, wanted, scheduler.quarantined, spent)
    return Exit.QUARANTINED if scheduler.quarantined else Exit.DONE


def _work(
    job: JobConfig, split: Path, scheduler: Scheduler, board: Board, sealer: Sealer, events: Events, stop: Stop
) -> None:
    """Have every unit done or given up, by workers or in this process."""

    def settle(outcomes: Sequence[UnitOutcome]) -> None:
        """Account for attempts that ended together."""
        failed: dict[tuple[str, bool], list[WorkUnit]] = {}  # by cause, and whether they are given up
        for outcome in outcomes:
            unit = outcome.unit
            board.ended(unit, outcome.summary)
            if outcome.fatal:
                events.ended(outcome)
                raise Failure(outcome.fatal)
            if outcome.summary:
                events.ended(outcome)
                sealer.committed(unit)
                continue
            last = scheduler.failed(unit)
            events.ended(outcome, last)
            failed.setdefault((outcome.cause, last), []).append(unit)
            if last:
                reason = f"Failed {scheduler.attempts[unit]} times, the last time with:\n\n{outcome.reason}\n"
                quarantine.give_up(split, unit.level_ids, reason)
        for (cause, last), units in failed.items():
            board.say(f"{levels_text(units).capitalize()} failed ({cause}): {'given up' if last else 'trying again'}.")
        if outcomes:
            sealer.look(scheduler.first)

    if job.executor == "inline":
        from levelproof.pipeline.jobs.inline import run
    else:
        from levelproof.pipeline.jobs.cluster import run
    run(job, split, scheduler, settle, board, stop)


def _spent(manifest: Manifest, made: np.ndarray, spent: EnvSteps) -> str:
    """What this run's env steps were for."""
    rows = manifest.table.filter(np.isin(manifest.level_ids, made))
    steps, label = (rows.column(name).to_numpy() for name in ("env_steps", "label"))
    shares = {
        "of searches": spent.searched,
        "of training that solved its level": steps[label == Label.SOLVED].sum(),
        "of training that did not": steps[label == Label.UNSOLVED].sum(),
        "of evaluations": spent.evaluated,
        "in empty slots": spent.idle,
    }
    told = ", ".join(f"{share / sum(spent):.0%} {name}" for name, share in shares.items() if share)
    return f"{sum(spent):,} env steps: {told}."


def _closing(split: Path, manifest: Manifest, wanted: np.ndarray, given_up: list[WorkUnit], spent: str) -> None:
    """Where it is, what came of it, and what to type next. On stdout."""
    labels, folder = manifest.counts(np.isin(manifest.level_ids, wanted)), shlex.quote(as_typed(split))
    total = sum(labels.values())
    counts = ", ".join(f"{count} {label}" for label, count in labels.items())
    print(f"{as_typed(split)}: {many(total, 'level') + ', ' + counts if total else 'nothing is committed'}.")
    if spent:
        print(spent)
    for unit in given_up:
        print(f"Given up: {levels_text([unit])}, for the reason in {as_typed(quarantine_path(split, unit.name))}")
    if total:
        print(f"Next:  levelproof inspect {folder}")
    solved = pc.index(manifest.table.column("label").cast("string"), Label.SOLVED.value).as_py()
    if solved >= 0:
        print(f"       levelproof show {folder} {manifest.level_ids[solved]} -o level.gif")
