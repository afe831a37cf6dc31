"""Which data teaches best: witnesses by different procedures, labels by teachers, and what experts show with noise.

Kinds of data are compared twice: on the same levels, and at the same cost of the data.

A stopped run resumes, except in a `generate`: every command continues what it left, and the folder keeps finished
evaluations.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.cloning import (
    GREEDY,
    SAMPLED,
    command,
    interval_text,
    kept,
    lines_of,
    slug,
    timed_command,
    timed_split,
)
from benchmarks.report import Report, Table
from levelproof.experts.imitation import ImitationConfig
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.learn.evaluate import SOLVED
from levelproof.pipeline.runtime import own_cores
from levelproof.pipeline.store.files import write
from levelproof.pipeline.store.manifest import require_manifest

FIRST, ATTEMPTS = 50_000, 8  # id of the first level; attempts at each sealed level
DATA = {  # name: settings of `levelproof generate`
    "default": ("budget=64k",),
    "label": ("budget=64k", "procedure=label"),
    "label, polished": ("budget=64k", "procedure=label", "search.polish=65536"),
    "masters": ("budget=256k", "procedure=masters", "keep_experts=true"),
}
DISTILLING = ("train.learning_rate=5e-4",)
AS_CLONES = tuple(f"train.{name}={getattr(ImitationConfig(), name)}" for name in ("learning_rate", "warmup", "average"))
SHOWING = ("states=0", "episodes=64", "demonstrations=512", *AS_CLONES)
ENOUGH = 0.95  # of the cost that a split is to have


class Distilled(NamedTuple):
    """A policy that `levelproof distill` trains."""

    data: str  # kind of DATA
    cloned: bool  # whether a clone takes half of the updates before
    settings: tuple[str, ...]
    about: str


DISTILLED = {
    "label, teachers": Distilled(
        "label", True, DISTILLING, "teachers, none of them an expert, label states that the learner itself gets into"
    ),
    "masters, teachers": Distilled(
        "masters", True, DISTILLING, "the levels' experts label these states, and the other teachers where they fail"
    ),
    "masters, rollouts": Distilled(
        "masters",
        False,
        (*SHOWING, "teachers.sticky=0", "teachers.perturbed=0"),
        "half of the transitions are of episodes that the levels' experts play anew, without noise",
    ),
    "masters, noisy rollouts": Distilled(
        "masters",
        False,
        SHOWING,
        "the same with noise: half of these episodes have sticky actions, and half, drawn independently, start with "
        "other velocities",
    ),
}
KINDS = (*DATA, *DISTILLED)
COLUMNS = {"sampled": (SAMPLED, "once"), "greedy": (GREEDY, "once"), "best of 8": (SAMPLED, "best")}


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", nargs="+", choices=KINDS, default=KINDS, help="default: all")
    parser.add_argument("--levels", type=int, default=1640, help="ids to make each kind of data of (default: 1640)")
    parser.add_argument("--cost", type=float, help="core-seconds of each kind's data in a further comparison")
    parser.add_argument("--seeds", type=int, default=2, help="policies of each kind (default: 2)")
    parser.add_argument("--updates", type=int, default=1000, help="updates of each policy (default: 1000)")
    parser.add_argument("--cost-updates", type=int, default=2500, help="the same in that comparison (default: 2500)")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="further settings of every policy")
    parser.add_argument("--measured", type=int, default=2048, help="sealed levels to measure on (default: 2048)")
    parser.add_argument("--folder", type=Path, default=Path("teaching"), help="where data and policies are kept")


def run(args: argparse.Namespace) -> Report:
    comparisons = [compared(args, cost) for cost in (None, *([args.cost] if args.cost else []))]
    results = [each for _, of_table in comparisons for each in of_table]
    tables, players = [table for table, _ in comparisons], results[0]["sealed"][SOLVED]
    return Report("Which data teaches best", results, tables, notes(args, players))


def notes(args: argparse.Namespace, players: Mapping[str, Any]) -> list[str]:
    """Say what is compared, and how."""
    settings = f", with {' '.join(f'`{setting}`' for setting in args.set)}" if args.set else ""
    at_cost = (
        f" At the same cost: the witnesses of each kind cost about {args.cost:,.0f} core-seconds, with ids from there "
        f"on, and policies take {args.cost_updates:,} updates on all of them; what teachers and experts then play "
        "counts as training."
        if args.cost
        else ""
    )
    procedures = dict.fromkeys(map(procedure_of, args.data))
    return [
        f"On the same levels: all policies learn from those that every procedure solves of the {args.levels:,} ids "
        f"from {FIRST:,} on, in {args.updates:,} updates{settings}.{at_cost} Of the {players['random']['levels']:,} "
        f"sealed levels, random actions solve {interval_text(players['random']['once'])}, sticky random actions "
        f"{interval_text(players['sticky random']['once'])}.",
        "; ".join(f"*{name}*: `levelproof generate {' '.join(DATA[name])}`" for name in procedures) + ".",
        *(about(name) for name in args.data if name in DISTILLED),
        "Core-seconds are CPU seconds, compiling included. Those of data are of the whole command, for all ids, solved "
        "or not; those of training are of all its commands, teachers and experts included. Steps to the goal: the mean "
        "of the witnesses. Clones keep a tenth of their levels for validation; `distill` learns from all.",
    ]


def compared(args: argparse.Namespace, cost: float | None) -> tuple[Table, list[dict[str, Any]]]:
    """Compare the kinds of data on the same levels, or at the same cost."""
    procedures = list(dict.fromkeys(map(procedure_of, args.data)))
    with ThreadPoolExecutor(len(own_cores())) as threads:
        made = dict(zip(procedures, threads.map(lambda name: generated(args, name, cost), procedures), strict=True))
        common = None if cost else sorted(set[int].intersection(*(set(one["steps"]) for one in made.values())))
        if not (cost or common):
            raise UserError("--data: none of the --levels is solved by all these procedures.")
        runs = [(name, seed) for seed in range(args.seeds) for name in args.data]
        updates = args.cost_updates if cost else args.updates
        of_run = lambda one: measured(args, made[procedure_of(one[0])], common, updates, *one)
        results = [*threads.map(of_run, runs)]
    rows = [
        [
            name,
            *facts(made[procedure_of(name)], common),
            str(each["seed"]),
            f"{each['core_seconds']:,.0f}",
            *rates(each["sealed"]),
        ]
        for name in args.data
        for each in results
        if each["data"] == name
    ]
    costs = "core-seconds of data", "per solved level"
    head = "data", "levels", *costs, "steps to goal", "seed", "core-seconds of training", *COLUMNS
    what = "at about the same cost of data" if cost else "on the same levels"
    title = f"Share of sealed levels labelled solved that a policy solves, {what}; 95% intervals over levels"
    return Table(head, rows, title), results


def procedure_of(name: str) -> str:
    """Return which kind of DATA this learns from."""
    return DISTILLED[name].data if name in DISTILLED else name


def about(name: str) -> str:
    """Say what a distilled policy is."""
    distilled = DISTILLED[name]
    before = "a clone of half as many updates, then as many of " if distilled.cloned else ""
    return f"*{name}*: {before}`levelproof distill {' '.join(distilled.settings)}`: {distilled.about}."


def generated(args: argparse.Namespace, name: str, cost: float | None) -> dict[str, Any]:
    """Make a split, as large as `cost` allows if there is one; return its solved levels, and what they cost."""
    out, words = args.folder / f"data-{slug(name)}", ("size=s", f"first_level={FIRST}", *DATA[name])
    if cost:
        out = out.with_name(f"{out.name}-{cost:g}")
        spent = grown(out, cost, args.levels, *words)
    else:
        spent = timed_split(out, f"levels={args.levels}", *words)
    split = split_in(out, words)
    rows = require_manifest(split, ["level_id", "label", "steps_to_goal"]).table.to_pylist()
    steps = {row["level_id"]: row["steps_to_goal"] for row in rows if row["label"] == "solved"}
    if not steps:
        raise UserError(f"No level of {split} is solved: raise {'--cost' if cost else '--levels'}.")
    return {"split": split, "steps": steps, "core_seconds": spent}


def grown(out: Path, cost: float, levels: int, *words: str) -> float:
    """Generate a split that takes about `cost` CPU seconds, unless an earlier run has; return the seconds.

    It grows part by part, as the part before suggests: the first one, of `levels` levels, compiles most programs.

    Raises:
        Failure: a run that was stopped has left a part of the levels, whose seconds nobody knows.
    """
    file = out.with_suffix(".json")
    parts = json.loads(file.read_text()) if file.exists() else []  # levels so far, and seconds of the part
    while (spent := sum(seconds for _, seconds in parts)) < ENOUGH * cost:
        begun, done = ([0, 0] + [until for until, _ in parts])[-2:]
        if out.exists() and len(require_manifest(split_in(out, words), ["level_id"]).table) != done:
            raise Failure(f"{out} was left by a run that was stopped: remove it, so that all its levels count.")
        until = done + (max(1, round((cost - spent) / (parts[-1][1] / (done - begun)))) if parts else levels)
        seconds = timed_command("generate", *words, f"levels={until}", f"out={out}", "executor=inline")[1]
        parts.append([until, seconds])
        write(file, json.dumps(parts).encode())
    return spent


def split_in(out: Path, words: Sequence[str]) -> Path:
    """Return the split of a job with these settings."""
    return out / next(word.removeprefix("budget=") for word in words if word.startswith("budget=")) / "s"


def measured(
    args: argparse.Namespace, data: Mapping[str, Any], levels: Sequence[int] | None, updates: int, name: str, seed: int
) -> dict[str, Any]:
    """Train one policy on these levels (None: on all that are solved), and measure it on sealed levels."""
    of = data["split"].parents[1].name.removeprefix("data")  # of all data of the kind
    where = f"level_id IN ({', '.join(map(str, levels))})" if levels is not None else "label = 'solved'"
    words = f"where={where}", f"seed={seed}"
    policy, distilled, spent, start = args.folder / f"clone{of}-{seed}", DISTILLED.get(name), 0.0, ()
    each = f"train.updates={updates // (1 + bool(distilled and distilled.cloned))}"
    if not distilled or distilled.cloned:
        policy = policy.with_name(f"{policy.name}-half") if distilled else policy
        command("clone", data["split"], "-o", policy, *words, each, *args.set)
        spent, start = lines_of(policy)[-1]["bc/core_seconds"], (f"start={policy}",)
    if distilled:
        policy = args.folder / f"{slug(name)}{of}-{seed}"
        changed = [word for word in args.set if not (start and word.startswith("network."))]  # the start has one
        whole = f"pool={len(data['steps'])}"
        command("distill", data["split"], "-o", policy, *words, each, whole, *start, *distilled.settings, *changed)
        spent += lines_of(policy)[-1]["distill/core_seconds"]
    sealed = kept(policy / "sealed.json", policy, "--attempts", ATTEMPTS, "--levels", args.measured)
    about = {"data": name, "data_core_seconds": data["core_seconds"], "updates": updates, "seed": seed}
    return about | {"levels": len(levels or data["steps"]), "core_seconds": spent, "sealed": sealed}


def facts(data: Mapping[str, Any], levels: Sequence[int] | None) -> list[str]:
    steps = data["steps"]
    learned, cost = list(steps) if levels is None else levels, data["core_seconds"]
    mean = np.mean([steps[level_id] for level_id in learned])
    return [f"{len(learned):,}", f"{cost:,.0f}", f"{cost / len(steps):.3f}", f"{mean:.1f}"]


def rates(sealed: Mapping[str, Any]) -> list[str]:
    return [interval_text(sealed[SOLVED][player][key]) for player, key in COLUMNS.values()]
