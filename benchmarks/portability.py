"""Share of witnesses that reach the goal in the reference: exported levels, its own loader and environment.

The default procedure labels levels. Of each solved level two witnesses are played: the chosen one, and the one chosen
without replays from perturbed starts.
"""

import argparse
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from benchmarks import oracle
from benchmarks.report import Report, Table
from levelproof.experts.config import RECORD_STEPS, ExpertConfig
from levelproof.experts.labels import Label
from levelproof.experts.pool.pool import Pool
from levelproof.experts.pool.run import TrainingRun
from levelproof.experts.procedure import Procedure
from levelproof.experts.verdict.judge import Witness, candidates_of
from levelproof.experts.verdict.portability import survival
from levelproof.levelgen.batching import take
from levelproof.levelgen.files.level_file import LevelFile, write_level_file
from levelproof.levelgen.level import SIZES, Level, concatenate_levels
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.look.figures import Share
from levelproof.pipeline.runtime import prepare_jax

BUDGET = 64_000  # env steps of an expert
FIRST = 1_000_000  # first level id; the search was tuned on others
UNIT = 64  # levels at a time
KINDS = ("chosen", "first")  # the most portable candidate, and the first candidate


class Played(NamedTuple):
    """Results on a size's solved levels; the first axis is KINDS."""

    portability: Float[np.ndarray, "2 level"]
    reached: Bool[np.ndarray, "2 level"]  # whether the goal was reached in the reference


class Solved(NamedTuple):
    """A level and its witnesses."""

    level: Level  # one lane
    level_id: int
    witnesses: tuple[Witness, Witness]  # KINDS


def solved(pool: Pool, level_ids: Int[np.ndarray, " level"], size: str) -> Iterator[Solved]:
    """Label levels; yield the solved ones."""
    levels = jax.tree.map(np.asarray, sample_levels(level_ids, SIZES[size]))
    run = TrainingRun(pool, levels, level_ids)
    while not pool.step():
        run.submit_searched()
    result, submission = run.finish(), run.submission
    assert submission is not None
    once = replace(pool.config, replays=0)
    for position, i in enumerate(run.left.tolist()):
        verdict = result.verdicts[i]
        if verdict.label is Label.SOLVED:
            assert verdict.witness is not None
            assert verdict.steps_to_goal is not None
            chosen = Witness(
                np.asarray(result.record.action)[..., i], verdict.witness, verdict.steps_to_goal, verdict.portability
            )
            first = candidates_of(submission.evaluations[position], submission.found.source[position], once)[0]
            yield Solved(take(levels, np.array([i])), int(level_ids[i]), (chosen, first))


def measured(python: Path, size: str, count: int, first: int) -> Played:
    """Measure the witnesses of `count` levels of a size."""
    pool = Pool(BUDGET, Procedure(), DEFAULT_RULES)
    ids = np.arange(first, first + count, dtype=np.int32)
    solved_levels = [
        solved_level
        for start in range(0, count, UNIT)
        for solved_level in solved(pool, ids[start : start + UNIT], size)
    ]
    oracle.log(f"{size}: {len(solved_levels)} of {count} levels are solved.")
    levels = concatenate_levels([solved_level.level for solved_level in solved_levels])
    level_ids = np.array([solved_level.level_id for solved_level in solved_levels], np.int32)
    kinds = list(zip(*(solved_level.witnesses for solved_level in solved_levels), strict=True))
    shares = [survival(levels, level_ids, kind, ExpertConfig().replays, DEFAULT_RULES) for kind in kinds]
    return Played(np.array(shares), in_reference(python, [solved_level.level for solved_level in solved_levels], kinds))


def in_reference(python: Path, levels: list[Level], kinds: list[tuple[Witness, ...]]) -> Bool[np.ndarray, "kind level"]:
    """Return whether witnesses of several kinds reach the goal in the reference; play equal ones once."""
    plays, index = dict[tuple[int, bytes], int](), np.zeros((len(kinds), len(levels)), int)
    for kind, witnesses in enumerate(kinds):
        for i, witness in enumerate(witnesses):
            index[kind, i] = plays.setdefault((i, np.asarray(witness.action, np.int32).tobytes()), len(plays))
    action = [np.frombuffer(action, np.int32).reshape(RECORD_STEPS, -1) for _, action in plays]
    return played(python, [levels[i] for i, _ in plays], np.stack(action, 1))[index]


def played(python: Path, levels: list[Level], action: Int[np.ndarray, "256 level 6"]) -> Bool[np.ndarray, " level"]:
    """Return whether each level's first episode ends in the goal in the reference."""
    with tempfile.TemporaryDirectory() as name:
        folder, actions, out = Path(name) / "levels", Path(name) / "actions.npz", Path(name) / "out.npz"
        folder.mkdir()
        for i, level in enumerate(levels):
            write_level_file(LevelFile(level, DEFAULT_RULES), folder / f"{i:06}.json")
        np.savez(actions, action=action[None])
        oracle.run_script(python, "witnesses", [out, actions, folder], "play witnesses in the reference")
        with np.load(out) as file:
            return file["reached"][0]


def result(size: str, levels: int, played: Played) -> dict:
    """Summarise one size as a JSON document."""
    kinds = {}
    for kind, portability, reached in zip(KINDS, *played, strict=True):
        survived_all = reached[portability == 1]
        kinds[kind] = {
            "reach_the_goal": share(reached),
            "interval": Share(int(reached.sum()), len(reached)).interval,
            "portability": float(portability.mean()),
            "survive_all": len(survived_all) / len(reached),
            "reach_the_goal_of_those": share(survived_all),
        }
    return {"size": size, "levels": levels, "witnesses": played.reached.shape[1], **kinds}


def share(reached: Bool[np.ndarray, " level"]) -> float:
    return float(reached.mean()) if len(reached) else float("nan")


def rows(result: Mapping) -> list[list[str]]:
    return [
        [
            result["size"],
            f"{result['witnesses']:,}",
            kind,
            f"{result[kind]['reach_the_goal']:.1%}",
            " to ".join(f"{x:.1%}" for x in result[kind]["interval"]),
            f"{result[kind]['portability']:.3f}",
            f"{result[kind]['survive_all']:.1%}",
            f"{result[kind]['reach_the_goal_of_those']:.1%}",
        ]
        for kind in KINDS
    ]


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", nargs="+", choices=list(SIZES), default=list(SIZES), help="default: all")
    parser.add_argument("--levels", type=int, nargs="+", default=[1024], help="levels of each size (default: 1,024)")
    parser.add_argument("--first", type=int, default=FIRST, help=f"first level id (default: {FIRST:,})")


def run(args: argparse.Namespace) -> Report:
    prepare_jax()
    if len(args.levels) not in (1, len(args.size)):
        raise UserError("--levels: give one number for all sizes, or one for each.")
    python = oracle.oracle_python()
    counts = np.broadcast_to(args.levels, len(args.size)).tolist()
    results = [
        result(size, count, measured(python, size, count, args.first))
        for size, count in zip(args.size, counts, strict=True)
    ]
    tried = " and ".join(f"{count:,} of {size}" for size, count in zip(args.size, counts, strict=True))
    head = ("size", "witnesses", "which", "reach the goal", "95% interval", "portability", "survive all", "of those")
    return Report(
        title="Witnesses in the reference",
        results=results,
        tables=[Table(head, [row for result in results for row in rows(result)])],
        notes=[
            f"{tried}, from id {args.first:,} on, experts of {BUDGET:,} env steps, the default procedure. Solved "
            "levels, exported as level files and played in the reference by its own loader and "
            "environment: the share of witnesses that end their first episode in the goal. *chosen*: the candidate "
            "that survives most replays from starts perturbed by a rounding error, or what a search around it finds; "
            "*first*: with `expert.replays=0`. *portability*: the mean share of these replays that reach the goal; "
            "*survive all*: the share of witnesses that reach it in every replay, and the share *of those* that reach "
            "it in the reference."
        ],
        reference=oracle.versions(python),
    )
