"""What a solved level costs by the default procedure, beside an earlier commit.

Both make the levels of the same ids, one after the other and each in a single process on one core, with the packages of
this environment. A small job goes before each, so that nothing is left to compile.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow.dataset as ds

from benchmarks.cloning import timed_process
from benchmarks.oracle import log
from benchmarks.report import Report, Table
from benchmarks.solved.results import share
from benchmarks.statistics import flips
from levelproof.experts.labels import Label
from levelproof.experts.steps import Seconds
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.runtime import CACHE_VARIABLE, cache_folder, own_cores

ROOT = Path(__file__).parents[1]
EARLIER, NOW = "earlier", "now"
COMMIT = "0318eda"  # of 2026-11-24
REPORT_LEVELS = "first_level=1100000"  # levels that reports measure
JOBS = (
    f"size=s budget=64k levels=1000 {REPORT_LEVELS}",
    f"size=m budget=256k levels=1000 {REPORT_LEVELS}",
    f"size=l budget=256k levels=500 {REPORT_LEVELS}",
)
SMALL = "levels=64"  # overrides a job's levels, to compile
ON_ONE_CORE = f"""
import os, sys
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, [{own_cores()[0]}])
from levelproof.__main__ import main
sys.exit(main())
"""
# stages whose seconds are told apart by label, and stages of all levels together
BY_LABEL = [(stage, label) for stage in ("search", "training") for label in (Label.SOLVED, Label.UNSOLVED)]
TOGETHER = {"evaluation": "evaluation", "replay": "replays"}
SETTLED = 6.0  # s until programs of sources that were just written are kept in the cache folder


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--against", default=COMMIT, metavar="COMMIT", help=f"the earlier commit (default: {COMMIT})")
    parser.add_argument("--jobs", nargs="+", default=JOBS, metavar="SETTINGS", help="settings of generate for each job")


def run(args: argparse.Namespace) -> Report:
    sources = {EARLIER: checked_out(args.against), NOW: ROOT}
    results = []
    for job in args.jobs:
        for version, folder in sources.items():
            log(f"{version}: {job}")
            generated(folder, [*job.split(), SMALL])
            results.append({"job": job, "version": version, **generated(folder, job.split())})
    return reported(args.against, args.jobs, results)


def reported(commit: str, jobs: Sequence[str], results: Sequence[Mapping[str, Any]]) -> Report:
    """Report each job's cost and solved share under both versions, where the cost goes, and labels level by level."""
    by = {(result["job"], result["version"]): result for result in results}
    cost = ("job", "version", "core-seconds", "undecided levels", "solved (95% interval)", "for each solved level")
    parts = [*(f"{stage} of {label} levels" for stage, label in BY_LABEL), *TOGETHER.values()]
    paired = ("job", "levels that both call undecided", f"only {commit} solves", "only today's solves", "p")
    return Report(
        title="What a solved level costs",
        results=results,
        tables=[
            Table(cost, [_cost(result, commit) for result in results]),
            Table(
                ("job", "version", *parts, "the rest"),
                [_spent(result, commit) for result in results],
                "Where the core-seconds of a solved level go",
            ),
            Table(paired, [_paired(job, by[job, EARLIER], by[job, NOW]) for job in jobs], "Level by level"),
        ],
        notes=[
            f"`levelproof generate executor=inline` on one core, at commit {commit} and at {_head()}, one after the "
            f"other. Core-seconds are CPU time of the command, from its start to its end; the same job with `{SMALL}` "
            "ran before, so nothing was left to compile. Undecided levels are neither trivial nor proved unsolvable. "
            "Commits before 2026-11-25 use sampler 1: the same levels, except for the last digits of their numbers. p: "
            "exact two-sided McNemar test. [What was tried](../tried/patience.md) says why l costs more than before.",
            "Where they go: by the manifest's `seconds`, which are those of a clock; the rest is starting, sampling, "
            "writing, empty slots, and reading compiled programs.",
        ],
    )


def _head() -> str:
    """Return the commit of this checkout, and whether its files differ from it."""
    of = lambda *words: subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True).stdout.strip()
    return of("rev-parse", "--short", "HEAD") + (" with changes" if of("status", "--porcelain", "--", "*.py") else "")


def checked_out(commit: str) -> Path:
    """Return a folder in the cache folder with the files of a commit.

    Raises:
        UserError: there is no such commit.
    """
    named = subprocess.run(["git", "rev-parse", "--verify", f"{commit}^{{commit}}"], cwd=ROOT, capture_output=True)
    if named.returncode:
        raise UserError(f"--against {commit}: this clone has no such commit; `git log` shows those it has")
    folder = cache_folder() / "commits" / named.stdout.decode().strip()
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(dir=folder.parent))
        archive = subprocess.run(["git", "archive", commit], cwd=ROOT, capture_output=True, check=True).stdout
        subprocess.run(["tar", "-x", "-C", str(made)], input=archive, check=True)
        made.rename(folder)
        time.sleep(SETTLED)
    return folder


def generated(sources: Path, settings: Sequence[str]) -> dict[str, Any]:
    """Generate levels with the package in `sources`, on one core.

    Returns:
        CPU seconds, labels by level id, and seconds of each stage by label.

    Raises:
        Failure: the command fails.
    """
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-c", ON_ONE_CORE, "generate", *settings, "executor=inline", f"out={out}"]
        environment = os.environ | {
            "PYTHONPATH": str(sources),
            CACHE_VARIABLE: str(cache_folder() / "cost" / sources.name),
        }
        environment.pop("PYTHONDONTWRITEBYTECODE", None)  # Python would compile all sources in every run
        name = f"`levelproof {' '.join(command[3:])}` in {sources}"
        # Python looks for modules in the working directory first
        _, seconds = timed_process(name, command, cwd=sources, env=environment)
        manifests = [str(path) for path in Path(out).glob("*/*/manifest")]
        columns = ["level_id", "label", "seconds"]
        rows = [row for path in manifests for row in ds.dataset(path, format="parquet").to_table(columns).to_pylist()]
    stages: dict[str, dict[str, float]] = {}
    for row in rows:
        spent = stages.setdefault(row["label"], dict.fromkeys(Seconds._fields, 0.0))
        for stage, took in row["seconds"].items():
            spent[stage] += took
    return {"seconds": seconds, "labels": {row["level_id"]: row["label"] for row in rows}, "stages": stages}


def _cost(result: Mapping[str, Any], commit: str) -> list[str]:
    labels = list(result["labels"].values())
    solved = labels.count(Label.SOLVED)
    undecided = solved + labels.count(Label.UNSOLVED)
    cost = f"{result['seconds'] / solved:.3f}" if solved else "-"
    numbers = f"{result['seconds']:,.0f}", f"{undecided:,}", share(solved, undecided), cost
    return [*_of(result, commit), *numbers]


def _spent(result: Mapping[str, Any], commit: str) -> list[str]:
    """Return core-seconds of a solved level by stage; they sum up to its cost."""
    solved = list(result["labels"].values()).count(Label.SOLVED)
    by_label = lambda label, stage: result["stages"].get(label, {}).get(stage, 0.0)
    parts = [by_label(label, stage) for stage, label in BY_LABEL]
    parts += [sum(spent[stage] for spent in result["stages"].values()) for stage in TOGETHER]
    parts.append(result["seconds"] - sum(parts))
    return [*_of(result, commit), *(f"{part / solved:.3f}" if solved else "-" for part in parts)]


def _of(result: Mapping[str, Any], commit: str) -> list[str]:
    """Return the cells that say which job and version a row is of."""
    return [f"`{result['job']}`", commit if result["version"] == EARLIER else "today's"]


def _paired(job: str, earlier: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    pairs = [(label, now["labels"].get(level)) for level, label in earlier["labels"].items()]
    return [f"`{job}`", *flips(pairs, Label.SOLVED, Label.UNSOLVED)]
