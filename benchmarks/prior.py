"""What a policy for all levels could save the search: attempts at levels before anything searches them.

The splits are those of the default procedure, so their manifests say what was found without the policy, and at what
cost. Attempts that reach the goal would save at most the whole search of their levels.
"""

import argparse
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from benchmarks.report import Report, Table
from levelproof.experts.evaluation import FirstEpisodes, play, play_sampled
from levelproof.experts.labels import Label
from levelproof.experts.networks.saved import Policy
from levelproof.levelgen.level import Level, name_of
from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.look.figures import Share
from levelproof.pipeline.read.levels import COLUMNS, levels_of, rules_of
from levelproof.pipeline.read.policies import policy_at, require_size
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.manifest import require_manifest

ATTEMPTS = 16
LANES = 256  # several batches even of few levels: the first one compiles, and is not timed
UNDECIDED = Label.SOLVED, Label.UNSOLVED
READ = (*COLUMNS, "steps_to_goal", "seconds", "command")


class Undecided(NamedTuple):
    """Levels of a split that were searched; level axis first, except in `levels`."""

    levels: Level
    level_ids: Int[np.ndarray, " level"]
    rules: TaskParams
    solved: Bool[np.ndarray, " level"]
    steps: Float[np.ndarray, " level"]  # to the goal by the split's witness; NaN without one
    searching: Float[np.ndarray, " level"]  # core-seconds of the search
    everything: float  # core-seconds of the whole split
    command: str


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("splits", nargs="+", type=Path, metavar="SPLIT", help="of the default procedure")
    many = "one for all splits, or one for each (default: builtin:s)"
    parser.add_argument("--policy", type=Path, nargs="+", default=[Path("builtin:s")], help=many)
    parser.add_argument("--attempts", type=int, default=ATTEMPTS, help=f"at each level (default: {ATTEMPTS})")
    parser.add_argument("--levels", type=int, help="use only the first levels of each split")


def run(args: argparse.Namespace) -> Report:
    prepare_jax()
    if len(args.policy) not in (1, len(args.splits)):
        raise UserError(f"--policy names {len(args.policy)} policies: name one, or one for each split.")
    names = args.policy * len(args.splits) if len(args.policy) == 1 else args.policy
    policies = {name: policy_at(name) for name in dict.fromkeys(names)}
    results = [measured(str(name), policies[name], split, args) for name, split in zip(names, args.splits, strict=True)]
    if unsolved := [split for one, split in zip(results, args.splits, strict=True) if not one["solved"]]:
        advice = "raise --levels or leave it out" if args.levels else "name another split"
        raise UserError(f"No level of {unsolved[0]} is solved, so none has a cost: {advice}.")
    found, saved = [], []
    for one in results:
        found.append(
            [
                one["size"],
                f"`{one['policy']}`",
                found_of(one["found_of_unsolved"], one["unsolved"]),
                found_of(one["found_of_solved"], one["solved"]),
                f"{one['steps_ratio']:.2f}",
            ]
        )
        each, all_levels = one["searching"] / one["solved"], one["everything"] / one["solved"]
        saved.append(
            [
                one["size"],
                *(f"{x:.3f}" for x in (all_levels, each, one["searching_found"] / one["solved"])),
                f"{one['attempting'] / one['solved']:.3f}",
            ]
        )
    total = lambda what: sum(one[what] for one in results)
    ratios = [one["attempting"] / max(one["searching_found"], 1e-9) for one in results]
    bounds = [one["searching_found"] / one["everything"] for one in results]
    commands = "; ".join(f"`{one['command']}`" for one in results)
    return Report(
        "Attempts of a policy before the search",
        results,
        [
            Table(
                ("size", "policy", "of unsolved levels", "of solved levels", "steps to goal, policy / witness, median"),
                found,
                f"Levels that a policy solves in {args.attempts} attempts with sampled actions; 95% intervals",
            ),
            Table(
                ("size", "everything", "search", "search of levels that the attempts solve", "the attempts"),
                saved,
                "Core-seconds for each level labelled solved",
            ),
        ],
        [
            f"The splits: {commands}. Their labels are those of a procedure that knows no policy. "
            "Levels that are trivial or proved unsolvable are left out.",
            "The attempts are made at all levels that would be searched. They would save at most *search of levels "
            "that the attempts solve*. They are timed in CPU seconds, without compiling; the other columns are seconds "
            "of a clock, from the manifest, which other work on the machine makes longer.",
            "The policy's steps are those of its shortest attempt that reaches the goal, on levels that both solve.",
            f"Attempts that cost nothing would save at most {', '.join(f'{100 * share:.0f}' for share in bounds)}% "
            f"of all core-seconds ({', '.join(one['size'] for one in results)}). {args.attempts} cost "
            f"{', '.join(f'{ratio:.0f}' for ratio in ratios)} times that, and find {total('found_of_unsolved')} of "
            f"{total('unsolved'):,} unsolved levels; fewer were not tried. So no setting lets a policy play before "
            "the search. Proposals within the search, and experts that start from the policy, are ruled out only "
            "[by an estimate](../tried/learners.md#a-policy-before-the-search).",
        ],
    )


def measured(name: str, policy: Policy, split: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Play the split's undecided levels, and return what that finds and costs."""
    some = undecided(split, args.levels)
    require_size(policy, some.levels.size, str(split), "choose another split")
    played, attempting = timed(policy, some, args.attempts)
    found = played.solved.any(1)
    shortest = np.where(played.solved, played.env_steps, np.inf).min(1)
    both = found & some.solved
    return {
        "policy": name,
        "size": name_of(some.levels.size),
        "command": some.command,
        "solved": int(some.solved.sum()),
        "unsolved": int((~some.solved).sum()),
        "found_of_solved": int(both.sum()),
        "found_of_unsolved": int((found & ~some.solved).sum()),
        "steps_ratio": float(np.median(shortest[both] / some.steps[both])) if both.any() else float("nan"),
        "everything": some.everything,
        "searching": float(some.searching.sum()),
        "searching_found": float(some.searching[found].sum()),
        "attempting": attempting,
    }


def undecided(split: Path, count: int | None) -> Undecided:
    """Read the levels of a split that were searched: all, or those among its first `count` levels."""
    manifest = require_manifest(split, READ)
    rows = manifest.table.sort_by("level_id").slice(0, count)
    steps = np.array(rows["steps_to_goal"].to_pylist(), float)
    seconds = rows["seconds"].to_pylist()
    if None in seconds:
        raise UserError(f"{split} does not say what its levels cost: name a split that `levelproof generate` wrote.")
    labels, searched = rows["label"].to_pylist(), np.array([one["search"] for one in seconds])
    these = np.flatnonzero([label in UNDECIDED for label in labels])
    if not len(these):
        raise UserError(
            f"{split} has no searched level among its first {len(labels)}: raise --levels, or name another."
        )
    command = rows["command"][0].as_py().replace(" levels=1", f" levels={len(labels)}")
    rows = rows.take(these)
    return Undecided(
        levels_of(manifest, rows),
        rows["level_id"].to_numpy(),
        rules_of(manifest),
        np.array([labels[i] == Label.SOLVED for i in these]),
        steps[these],
        searched[these],
        sum(sum(one.values()) for one in seconds),
        command,
    )


def timed(policy: Policy, some: Undecided, attempts: int) -> tuple[FirstEpisodes, float]:
    """Make the attempts; return them, and their core-seconds at the rate of all batches but the first."""
    ends = list[tuple[int, float]]()
    follow = lambda levels: ends.append((levels, time.process_time()))
    player = play_sampled(policy.network)
    played = play(player, policy.params, some.levels, some.level_ids, attempts, 0, some.rules, follow, LANES)
    count = len(some.level_ids)
    after = sum(levels for levels, _ in ends[1:])
    return played, (ends[-1][1] - ends[0][1]) * count / after if after else float("nan")


def found_of(found: int, levels: int) -> str:
    return f"{found} of {levels}, {Share(found, levels)}"
