"""The variant `original`: our levels in the reference's own environment, trained by its users' PPO.

A process of the reference's Python (benchmarks/reference/solved.py) trains and evaluates. Its evaluations are judged
here, as for every variant, but witnesses are not replayed: they hold in the reference's physics only.
"""

import json
import signal
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Int, Shaped

from benchmarks import oracle
from benchmarks.contest import Process
from benchmarks.solved.measure import Progress, Trained, row_of
from benchmarks.solved.results import Header
from benchmarks.solved.variants import Variant
from levelproof.experts.config import RECORD_STEPS, ExpertConfig
from levelproof.experts.labels import Cause, Label, Source, Verdict
from levelproof.experts.steps import EnvSteps, Totals
from levelproof.levelgen.level import Level
from levelproof.pipeline.errors import LevelproofError
from levelproof.pipeline.jobs.schedule import Summary, WorkUnit
from levelproof.pipeline.runtime import cache_folder, prepare_jax
from levelproof.pipeline.store.provenance import device, versions

WIDTH = 8  # levels that the reference trains side by side; empty slots of a last batch are not charged


def work(core: int, header: Header, variant: Variant, tasks: Any, messages: Any) -> None:
    """Train units until none is left, as `measure.work` does; the reference's process shares the core."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the main process ends the others
    prepare_jax(core)
    try:
        python = oracle.oracle_python()
        made_with = {**versions(), "reference": oracle.versions(python)}
        with started(python, core, header, variant.procedure.expert) as reference:
            while (unit := tasks.get()) is not None:
                rows, summary = train(reference, header, variant.procedure.expert, unit, messages.put)
                messages.put(Trained(unit, rows, summary, made_with, device()))
    except LevelproofError as error:
        messages.put(error)


@dataclass(frozen=True)
class Reference:
    """The reference's process, and the folder through which arrays are exchanged."""

    process: Process
    folder: Path

    def ask(self, **request: str) -> dict[str, Any]:
        self.process.send(json.dumps(request))
        return self.process.answer()


@contextmanager
def started(python: Path, core: int, header: Header, config: ExpertConfig) -> Iterator[Reference]:
    """Run the reference's process in the `with` block.

    Raises:
        Failure: the process ends early.
    """
    arguments = ["--size", header.size, "--width", WIDTH, "--core", core, "--cache", cache_folder() / "reference-jax"]
    arguments += ["--environments", config.environments, "--horizon", config.horizon]
    arguments += ["--attempts", config.attempts, "--steps", RECORD_STEPS]
    command = [str(argument) for argument in (python, oracle.SCRIPTS / "solved.py", *arguments)]
    with ExitStack() as stack, tempfile.TemporaryFile("w+") as errors, tempfile.TemporaryDirectory() as folder:
        process = Process(command, oracle.environment(), stack, errors)
        process.start()
        process.answer()
        yield Reference(process, Path(folder))


def train(
    reference: Reference,
    header: Header,
    config: ExpertConfig,
    unit: WorkUnit,
    report_progress: Callable[[Progress], None],
) -> tuple[list[dict[str, Any]], Summary]:
    """Train a unit's levels; return their lines. Levels that need no expert are decided here, at no cost.

    Raises:
        Failure: the reference's process ended.
    """
    import jax.numpy as jnp

    from levelproof.experts.verdict.before import decide
    from levelproof.levelgen.batching import take
    from levelproof.levelgen.level import size_of
    from levelproof.levelgen.sampling.sampler import sample_levels
    from levelproof.levelgen.task.rules import DEFAULT_RULES

    ids, updates = np.asarray(unit.level_ids, np.int32), config.updates_in(header.budget)
    levels = sample_levels(jnp.asarray(ids), size_of(header.size))
    before, failed = decide(levels, DEFAULT_RULES)
    undecided = np.array([i for i, verdict in enumerate(before) if verdict is None], int)
    rows = [row_of(int(i), verdict, 0.0) for i, verdict in zip(ids, before, strict=True) if verdict]
    known_before, solved = len(rows), 0
    for first in range(0, len(undecided), WIDTH):
        batch = undecided[first : first + WIDTH]

        def report(share: float, first: int = first, count: int = len(batch), solved: int = solved) -> None:
            through = first + share * count
            steps = round(through * updates) * config.steps_per_update
            report_progress(Progress(unit, Totals(steps, known_before + through, solved)))

        seconds, arrays = train_batch(reference, take(levels, batch), ids[batch], updates, report)
        verdicts = [judged(shown, config, bool(failed[i])) for i, shown in zip(batch, arrays, strict=True)]
        rows += [row_of(int(ids[i]), verdict, seconds / WIDTH) for i, verdict in zip(batch, verdicts, strict=True)]
        solved += sum(verdict.label is Label.SOLVED for verdict in verdicts)
    steps, evaluated = updates * config.steps_per_update, config.attempts * RECORD_STEPS
    spent = EnvSteps(trained=len(undecided) * steps, evaluated=len(undecided) * evaluated)
    summary = Summary(len(ids), solved, spent)
    return sorted(rows, key=lambda row: row["level_id"]), summary


def train_batch(
    reference: Reference,
    levels: Level,
    level_ids: Int[np.ndarray, " level"],
    updates: int,
    report: Callable[[float], None],
) -> tuple[float, list[dict[str, Shaped[np.ndarray, "..."]]]]:
    """Train and evaluate a batch; return its core-seconds and each level's arrays (see `judged`).

    Raises:
        Failure: the reference's process ended.
    """
    from levelproof.levelgen.files.kinetix import state_to_kinetix
    from levelproof.levelgen.task.rules import NO_DISTANCE

    worlds, out, count = reference.folder / "levels.npz", reference.folder / "out.npz", len(level_ids)
    start = levels.state, np.zeros(count, np.int32), np.full(count, NO_DISTANCE, np.float32)
    np.savez(worlds, level_id=level_ids, **state_to_kinetix(levels, *start))  # pyright: ignore[reportArgumentType]
    reference.ask(do="begin", levels=str(worlds))
    for update in range(updates):
        reference.ask(do="update")
        report((update + 1) / updates)
    seconds = reference.ask(do="evaluate", out=str(out))["core_seconds"]
    with np.load(out) as file:
        arrays = {name: file[name] for name in file.files}
    return seconds, [{name: x[i] for name, x in arrays.items()} for i in range(count)]


def judged(arrays: dict[str, Shaped[np.ndarray, "..."]], config: ExpertConfig, failed_by_noop: bool) -> Verdict:
    """Judge a level by the rules for our own experts.

    Args:
        arrays: arrays from the reference's process: `trained_done` and `trained_goal` (env step, environment) of
            training; `action` (step, attempt, 6), `done` and `goal` (step, attempt) of the evaluation.
        config: the expert's configuration.
        failed_by_noop: whether green touches red if nothing acts.
    """
    import jax
    import jax.numpy as jnp

    from levelproof.experts.training import progress
    from levelproof.experts.verdict import judge
    from levelproof.experts.witness.success import no_success
    from levelproof.experts.witness.witness import succeeds

    done, goal = arrays["trained_done"], arrays["trained_goal"]
    totals = progress.Progress(
        episode_return=jnp.zeros(config.environments),
        best_return=jnp.float32(jnp.nan),  # unknown
        episodes=jnp.int32(done.sum()),
        env_steps=jnp.int32(done.size),
        first_success=jnp.int32(first_success(goal)),
        diverged=jnp.int32(progress.NEVER),
    )
    nothing = jax.tree.map(lambda x: x[0], no_success(1))
    evaluation = judge.Evaluation(
        np.moveaxis(arrays["action"], -1, 1), arrays["done"], arrays["goal"], totals, nothing, Cause.NONE
    )
    witness = next(iter(judge.candidates_of([evaluation], Source.EXPLORATION, config)), None)
    of_witness = np.argmax(succeeds(arrays["done"], arrays["goal"]))
    episodes = int(arrays["done"][:, of_witness].sum())
    return judge.verdict_of(judge.TrainedLevel([], [evaluation]), witness, episodes, config, failed_by_noop)


def first_success(goal: Bool[np.ndarray, "step environment"]) -> int:
    """Return the env steps of training, over all environments, until the first success."""
    from levelproof.experts.training.progress import NEVER

    reached = goal.any(1)
    return int((np.argmax(reached) + 1) * goal.shape[1]) if reached.any() else NEVER
