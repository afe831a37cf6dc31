"""Which data teaches best: witnesses of the same levels, made by different procedures, and labels by teachers.

A stopped run resumes, except in a `generate`: every command continues what it left, and the folder keeps finished
evaluations.
"""

import argparse
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cloning import GREEDY, SAMPLED, command, interval_text, kept, lines_of, timed_split
from benchmarks.learners import slug
from benchmarks.report import Report, Table
from levelproof.pipeline.learn.evaluate import SOLVED
from levelproof.pipeline.runtime import own_cores
from levelproof.pipeline.store.manifest import require_manifest

FIRST, ATTEMPTS = 50_000, 8  # id of the first level; attempts at each sealed level
DATA = {  # name: settings of `levelproof generate`
    "default": ("budget=64k",),
    "label": ("budget=64k", "procedure=label"),
    "label, polished": ("budget=64k", "procedure=label", "search.polish=65536"),
    "masters": ("budget=256k", "procedure=masters"),
}
TEACHERS = "label, teachers"  # witnesses of "label" for half of the updates, then labels of the learner's own states
KINDS = (*DATA, TEACHERS)
DISTILLING = ("train.learning_rate=5e-4",)
TEACHING = (
    f"*{TEACHERS}*: a clone of half as many updates, then as many of `levelproof distill {' '.join(DISTILLING)}`, on "
    "the same levels: teachers label states that the learner itself gets into."
)
COLUMNS = {"sampled": (SAMPLED, "once"), "greedy": (GREEDY, "once"), "best of 8": (SAMPLED, "best")}


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", nargs="+", choices=KINDS, default=KINDS, help="default: all")
    parser.add_argument("--levels", type=int, default=1640, help="ids to make each kind of data of (default: 1640)")
    parser.add_argument("--seeds", type=int, default=2, help="clones of each kind (default: 2)")
    parser.add_argument("--updates", type=int, default=1500, help="updates of each clone (default: 1500)")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="further settings of every clone")
    parser.add_argument("--measured", type=int, default=2048, help="sealed levels to measure on (default: 2048)")
    parser.add_argument("--folder", type=Path, default=Path("teaching"), help="where data and policies are kept")


def run(args: argparse.Namespace) -> Report:
    procedures = list(dict.fromkeys(procedure_of(name) for name in args.data))
    with ThreadPoolExecutor(len(own_cores())) as threads:
        made = dict(zip(procedures, threads.map(lambda name: generated(args, name), procedures), strict=True))
        data = {name: made[procedure_of(name)] for name in args.data}
        common = set.intersection(*(one["solved"] for one in data.values()))
        runs = [(name, seed) for seed in range(args.seeds) for name in args.data]
        results = [*threads.map(lambda one: measured(args, data[one[0]], sorted(common), *one), runs)]
    rows = [
        [name, *facts(data[name], common), str(each["seed"]), f"{each['core_seconds']:,.0f}", *rates(each["sealed"])]
        for name in args.data for each in results if each["data"] == name
    ]  # fmt: skip
    players = results[0]["sealed"][SOLVED]
    head = ("data", "core-seconds of a solved level", "steps to goal", "seed", "core-seconds of training", *COLUMNS)
    return Report(
        "Which data teaches best",
        results,
        [Table(head, rows, "Share of sealed levels labelled solved that a policy solves; 95% intervals over levels")],
        [
            f"All policies learn from the same {len(common):,} levels, those among ids {FIRST:,} to "
            f"{FIRST + args.levels - 1:,} that every procedure solves, and take {args.updates:,} updates"
            f"{', with ' if args.set else ''}{' '.join(f'`{setting}`' for setting in args.set)}. Random actions solve "
            f"{interval_text(players['random']['once'])} of the {players['random']['levels']:,} sealed levels.",
            "; ".join(f"*{name}*: `levelproof generate {' '.join(DATA[name])}`" for name in procedures) + ".",
            *([TEACHING] if TEACHERS in args.data else []),
            "Core-seconds are CPU seconds, compiling included: of a solved level those of the whole command, "
            "unsolved levels included; of training those of all its commands, teachers included. Steps to the goal: "
            "the mean of the witnesses.",
        ],
    )  # fmt: skip


def procedure_of(name: str) -> str:
    """Return which kind of DATA this learns from."""
    return "label" if name == TEACHERS else name


def generated(args: argparse.Namespace, name: str) -> dict[str, Any]:
    """Make a split; return where it is, its solved levels, and what they cost."""
    out = args.folder / f"data-{slug(name)}"
    spent = timed_split(out, "size=s", f"levels={args.levels}", f"first_level={FIRST}", *DATA[name])
    split = out / DATA[name][0].removeprefix("budget=") / "s"
    table = require_manifest(split, ["level_id", "label", "steps_to_goal"]).table
    rows = {row["level_id"]: row for row in table.to_pylist()}
    solved = {level_id for level_id, row in rows.items() if row["label"] == "solved"}
    return {
        "split": split,
        "solved": solved,
        "steps": {level_id: rows[level_id]["steps_to_goal"] for level_id in solved},
        "core_seconds": spent,
    }


def measured(args: argparse.Namespace, data: Mapping[str, Any], common: Sequence[int], name: str, seed: int) -> Any:
    """Train one policy, and measure it on sealed levels."""
    policy = args.folder / f"clone-{slug(name)}-{seed}"
    words = f"where=level_id IN ({', '.join(map(str, common))})", f"seed={seed}"
    updates = f"train.updates={args.updates // 2 if name == TEACHERS else args.updates}"
    command("clone", data["split"], "-o", policy, *words, updates, *args.set)
    spent = lines_of(policy)[-1]["bc/core_seconds"]
    if name == TEACHERS:
        start, policy = policy, args.folder / f"distilled-{seed}"
        command("distill", data["split"], "-o", policy, *words, updates, f"start={start}", *DISTILLING)
        spent += lines_of(policy)[-1]["distill/core_seconds"]
    sealed = kept(policy / "sealed.json", policy, "--attempts", ATTEMPTS, "--levels", args.measured)
    return {"data": name, "seed": seed, "core_seconds": spent, "sealed": sealed}


def facts(data: Mapping[str, Any], common: set[int]) -> list[str]:
    steps = np.mean([data["steps"][level_id] for level_id in common])
    return [f"{data['core_seconds'] / len(data['solved']):.3f}", f"{steps:.1f}"]


def rates(sealed: Mapping[str, Any]) -> list[str]:
    return [interval_text(sealed[SOLVED][player][key]) for player, key in COLUMNS.values()]
