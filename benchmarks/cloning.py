"""How well cloned policies solve levels they have never seen, against the number of levels they were cloned from.

All policies see equally many transitions, whatever their number of levels. A stopped run resumes: `levelproof clone`
resumes from its checkpoint, and the folder keeps finished evaluations.
"""

import argparse
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.report import Report, Table
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.runtime import own_cores
from levelproof.pipeline.store.manifest import require_manifest

LEVELS, SEEDS, UPDATES, ATTEMPTS = (100, 1000, 5000), 2, 1000, 8
POLICY, BASELINES = ("policy, sampled", "policy, greedy"), ("doing nothing", "random", "sticky random")


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("split", type=Path, help="split to clone from, with enough solved levels")
    parser.add_argument("--levels", type=int, nargs="+", default=LEVELS, help="solved levels to clone from")
    parser.add_argument("--seeds", type=int, default=SEEDS, help=f"policies per number of levels (default: {SEEDS})")
    parser.add_argument("--updates", type=int, default=UPDATES, help=f"updates of each policy (default: {UPDATES})")
    parser.add_argument("--measured", type=int, default=2048, help="sealed levels to measure on (default: 2048)")
    parser.add_argument("--folder", type=Path, default=Path("cloning"), help="where policies are kept")


def run(args: argparse.Namespace) -> Report:
    table = require_manifest(args.split, ["level_id", "label"]).table
    solved = table["level_id"].to_numpy()[np.array(table["label"].to_pylist()) == "solved"]
    if max(args.levels) > len(solved):
        raise UserError(f"{args.split} has {len(solved)} solved levels: choose fewer with --levels.")
    runs = [(count, seed) for count in args.levels for seed in range(args.seeds)]
    with ThreadPoolExecutor(len(own_cores())) as threads:
        results = [*threads.map(lambda one: measured(args, int(solved[one[0] - 1]), *one), runs)]
    rows = [row_of(count, [each for each in results if each["levels"] == count]) for count in args.levels]
    head = ("cloned from", "sampled", "greedy", "best of 8, sampled", "sampled, on levels cloned from")
    title = (
        f"Share of {args.measured} sealed levels solved in one attempt: mean over {args.seeds} seeds (least to most)"
    )
    baselines = results[0]["sealed"]["all"]
    others = [[name, *(interval_text(baselines[name][key]) for key in ("once", "best"))] for name in BASELINES]
    idle = baselines["doing nothing"]["once"]["rate"]
    notes = [
        f"Each policy took {args.updates:,} updates of 1,024 transitions.",
        "A tenth of the levels that it was cloned from were kept from training, for validation.",
        f"Doing nothing solves {idle:.1%} of the levels; not all of the others can be solved.",
    ]
    second = Table(("baseline", "one attempt", "best of 8"), others, "The same levels, with 95% intervals over levels")
    return Report("Cloning against the number of levels", results, [Table(head, rows, title), second], notes)


def measured(args: argparse.Namespace, last: int, count: int, seed: int) -> dict[str, Any]:
    """Clone one policy from the first `count` solved levels, the last of which has id `last`; measure it."""
    policy = args.folder / f"{count}-{seed}"
    chosen = f"label = 'solved' AND level_id <= {last}"
    command("clone", args.split, "-o", policy, f"where={chosen}", f"train.updates={args.updates}", f"seed={seed}")
    words = "--attempts", str(ATTEMPTS)
    sealed = kept(policy / "sealed.json", policy, *words, "--levels", str(args.measured))
    seen = kept(policy / "seen.json", policy, *words, "--on", args.split, "--where", chosen, "--levels", "1024")
    return {"levels": count, "seed": seed, "sealed": sealed, "seen": seen}


def kept(file: Path, *words: Any) -> dict[str, Any]:
    """Return an evaluation's rates, from its file if an earlier run made it."""
    if not file.exists():
        file.write_text(command("evaluate", *words, "--json"))
    return json.loads(file.read_text())["levels"][0]["of"]


def command(*words: Any) -> str:
    """Run a command; return its output. Raise Failure with the last line of its errors if it fails."""
    done = subprocess.run(
        [sys.executable, "-m", "levelproof", *map(str, words)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise Failure(f"levelproof {words[0]} failed: {done.stderr.strip().splitlines()[-1]}")
    return done.stdout


def row_of(count: int, results: list[dict[str, Any]]) -> list[str]:
    once = lambda where, name, key="once": range_text([each[where]["all"][name][key]["rate"] for each in results])
    return [f"{count:,}", *(once("sealed", name) for name in POLICY), once("sealed", POLICY[0], "best"),
            once("seen", POLICY[0])]  # fmt: skip


def range_text(rates: list[float]) -> str:
    return f"{np.mean(rates):.1%} ({min(rates):.1%} to {max(rates):.1%})"


def interval_text(rate: dict[str, Any]) -> str:
    low, high = rate["interval"]
    return f"{rate['rate']:.1%} ({low:.1%} to {high:.1%})"
