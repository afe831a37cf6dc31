"""The jobs of `levelproof generate`: plan the missing units, run them on an executor, report to the user."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
from rich.console import Console

from levelproof.configs.schema import GrowConfig, JobConfig
from levelproof.experts.labels import Label
from levelproof.experts.steps import EnvSteps
from levelproof.pipeline.errors import Exit, UserError
from levelproof.pipeline.jobs.choice import runs_here
from levelproof.pipeline.jobs.events import Events, recording
from levelproof.pipeline.jobs.log import logged, require_library
from levelproof.pipeline.jobs.progress import Board, Tally
from levelproof.pipeline.jobs.schedule import Scheduler, UnitOutcome, WorkUnit, levels_text, schedule
from levelproof.pipeline.jobs.seal import Sealer, sealing
from levelproof.pipeline.processes import in_another_process
from levelproof.pipeline.read.level_files import Listing, levels_below
from levelproof.pipeline.runtime import cache_folder, own_cores, prepare_jax
from levelproof.pipeline.stopping import Stop, stoppable
from levelproof.pipeline.store import quarantine
from levelproof.pipeline.store.checkpoints import require_same_experts
from levelproof.pipeline.store.job_note import note_job
from levelproof.pipeline.store.layout import quarantine_path
from levelproof.pipeline.store.manifest import Manifest, read_manifest
from levelproof.pipeline.store.origins import Origin, require_same_levels
from levelproof.pipeline.store.paused import prune_paused
from levelproof.pipeline.store.progress_bar import say
from levelproof.pipeline.store.runs import ascending, inside, merged, runs
from levelproof.pipeline.store.split import writing
from levelproof.pipeline.urls import as_typed, quoted
from levelproof.pipeline.words import many


def generate(
    job: JobConfig,
    command: Sequence[str],
    console: Console,
    level_ids: Sequence[int] | None = None,
    origins: Mapping[int, Origin] | None = None,
    repaired: Path | None = None,
) -> Exit:
    """Make the job's missing levels, and commit them unit by unit.

    Args:
        job: what to make.
        command: the command as typed, which status and notes quote.
        console: receives progress and messages.
        level_ids: levels to make; None: those of the job.
        origins: level files or records by level id; None: levels are sampled.
        repaired: the split, if this is a repair; None: `job` names it.

    Raises:
        UserError, Failure: see `log.require_library`, `runtime.cache_folder`, `store.split.writing` and
            `store.checkpoints.require_same_experts`; or a write failed.
        KeyboardInterrupt: stopped by Ctrl-C or SIGTERM; committed units stay.
    """
    require_library(job.log)
    cache_folder()  # checked here, because Ray wraps a worker's error in many lines
    require_same_experts(job)
    tell = partial(say, console)
    with stoppable() as stop, writing(job, tell, repaired) as (split, manifest):
        chosen = [*origins] if origins else (job.level_ids if level_ids is None else level_ids)
        wanted = ascending(np.fromiter(chosen, np.int64, len(chosen)))
        done = manifest.level_ids[np.isin(manifest.level_ids, wanted)]
        require_same_levels(split, origins or {}, done)
        left = len(wanted) - len(done)
        scheduler = schedule(chosen, done, left, job.levels_per_unit, job.unit is None, origins)
        _tidy(split, manifest, tell)
        if not repaired:
            note_job(split, job, command, merged(runs(wanted), runs(manifest.level_ids)))
        spent = ""
        if scheduler.waiting:
            tally = _make(job, split, manifest, wanted, scheduler, command, console, stop)
            manifest = read_manifest(split, ["label", "env_steps"], compact=True)
            _tidy(split, manifest, tell)
            if isinstance(job, GrowConfig):
                note_job(split, job, command, merged(_grown(split, manifest, wanted), runs(manifest.level_ids)))
            spent = _spent(manifest, np.setdiff1d(wanted, done), tally.spent) if tally.spent.shown else ""
        else:
            print(f"Nothing to do: the split already has {many(len(wanted), 'level')}.")
        _closing(split, manifest, wanted, scheduler.quarantined, spent)
    return Exit.QUARANTINED if scheduler.quarantined else Exit.DONE


@stoppable()
def generate_from_files(job: JobConfig, command: Sequence[str], console: Console) -> Exit:
    """Label the levels of `job.level_files`, one size after another; report and leave out unusable files.

    Returns INPUT if a file was left out, else the largest exit code of the splits.

    Raises:
        UserError: no file can be used; or see `generate`.
        Failure: see `generate`.
    """
    folder = Path(job.level_files).expanduser()
    if job.executor == "inline":
        prepare_jax(device=job.device, threads=len(own_cores()))
        listing = levels_below(folder, job)
    else:
        listing = in_another_process(_listed, folder, job)
    for sentence in (*listing.copies, *listing.refused):
        say(console, sentence)
    if not listing.levels:
        raise UserError(f"None of the level files in {folder} can be used, for the reasons above: fix one of them.")
    # One choice for all sizes, because Ray forks this process, which must not have started JAX before
    count = sum(map(len, listing.levels.values()))
    here = all(runs_here(replace(job, size=size), count) for size in listing.levels)
    job = replace(job, executor="inline" if here else "ray")
    exits = [
        generate(replace(job, size=size), command, console, origins=origins) for size, origins in listing.levels.items()
    ]
    if listing.refused:
        say(console, f"{len(listing.refused)} of the level files in {folder} were left out, for the reasons above.")
        return Exit.INPUT
    return max(exits)


def _tidy(split: Path, manifest: Manifest, tell: Callable[[str], None]) -> None:
    """Delete notes on failures and checkpoints of committed levels."""
    quarantine.drop_notes(split, manifest.level_ids)
    prune_paused(split, manifest.level_ids, tell)


def _grown(split: Path, manifest: Manifest, wanted: np.ndarray) -> list[tuple[int, int]]:
    """Return runs of the wanted levels that are committed or were given up, without those that a Grower left out."""
    given_up = np.array(merged(*quarantine.given_up(split, manifest.level_ids).values()), np.int64).reshape(-1, 2)
    return runs(wanted[np.isin(wanted, manifest.level_ids) | inside(wanted, given_up)])


def _make(
    job: JobConfig,
    split: Path,
    manifest: Manifest,
    wanted: np.ndarray,
    scheduler: Scheduler,
    command: Sequence[str],
    console: Console,
    stop: Stop,
) -> Tally:
    """Make the levels that the scheduler holds; report progress, events and seals. Returns the counts at the end."""
    is_done = np.isin(manifest.level_ids, wanted)
    count, there = many(len(wanted), "level"), int(is_done.sum())
    tally = Tally(len(wanted), there, manifest.counts(is_done).get(Label.SOLVED, 0))
    board = Board(tally, console)
    already = f", {there} are already there" if there else ""
    board.say(f"{count} of size {job.size}, {job.origin}, into {as_typed(split)}{already}")
    try:
        with (
            logged(job, split, board.say) as log,
            board.shown(),
            sealing(split, manifest.counting, board.say) as sealer,
            recording(split, board, scheduler, shlex.join(command), log) as events,
        ):
            _work(job, split, scheduler, board, sealer, events, stop)
            sealer.finish(board.sealing)  # before the run's last event
    except KeyboardInterrupt:
        board.say(f"Stopped: {tally.done:,} of {count} committed; run the same command to continue.")
        raise
    return tally


def _listed(folder: Path, job: JobConfig) -> Listing:
    prepare_jax(device="cpu")
    return levels_below(folder, job)


def _work(
    job: JobConfig, split: Path, scheduler: Scheduler, board: Board, sealer: Sealer, events: Events, stop: Stop
) -> None:
    """Run the executor until every unit is committed or given up."""

    def settle(outcomes: Sequence[UnitOutcome]) -> None:
        """Account for attempts that ended together."""
        failed: dict[tuple[str, bool], list[WorkUnit]] = {}  # by cause, and whether they are given up
        for outcome in outcomes:
            unit = outcome.unit
            board.ended(unit, outcome.summary)
            if outcome.fatal:
                events.ended(outcome)
                raise outcome.kind(outcome.fatal)
            if outcome.summary:
                events.ended(outcome)
                sealer.committed(outcome.summary.fragment or unit.name, outcome.summary.levels)
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
            sealer.advance(scheduler.first)

    if runs_here(job, board.tally.levels - board.tally.done):
        from levelproof.pipeline.jobs.inline import run
    else:
        from levelproof.pipeline.jobs.cluster import run
    run(job, split, scheduler, settle, board, stop)


def _spent(manifest: Manifest, made: np.ndarray, spent: EnvSteps) -> str:
    """Return a sentence on how this run's env steps were used."""
    rows = manifest.table.filter(np.isin(manifest.level_ids, made))
    steps, label = (rows.column(name).to_numpy() for name in ("env_steps", "label"))
    solved, unsolved = (steps[label == kind].sum() for kind in (Label.SOLVED, Label.UNSOLVED))
    trained = spent.trained / max(solved + unsolved, 1)  # rows of continued experts count earlier runs, too
    shares = {
        "in searches": spent.searched,
        "in training on solved levels": solved * trained,
        "in training on unsolved levels": unsolved * trained,
        "in evaluations": spent.evaluated,
        "in empty slots": spent.idle,
        "in replays of witnesses": spent.replayed,
    }
    parts = ", ".join(f"{share / sum(spent):.0%} {name}" for name, share in shares.items() if share)
    return f"{sum(spent):,} env steps: {parts}."


def _closing(split: Path, manifest: Manifest, wanted: np.ndarray, given_up: list[WorkUnit], spent: str) -> None:
    """Print where the split is, its labels, and the next command to type."""
    labels, folder = manifest.counts(np.isin(manifest.level_ids, wanted)), quoted(split)
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
