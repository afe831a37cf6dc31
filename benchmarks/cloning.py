"""How well cloned policies solve levels they have never seen, against the number of levels they were cloned from.

All policies see equally many transitions, whatever their number of levels, except those with twice the updates. A
stopped run resumes: `levelproof clone` resumes from its checkpoint, and the folder keeps finished evaluations.
"""

import argparse
import hashlib
import itertools
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

import levelproof
from benchmarks.plotting import pyplot, save
from benchmarks.report import Report, Table
from levelproof.experts.networks.saved import WEIGHTS, policy_folder
from levelproof.levelgen.identity.keys import SAMPLER_VERSION
from levelproof.levelgen.level import name_of
from levelproof.physics.step import ENGINE_VERSION
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.learn.evaluate import ALL, SOLVED
from levelproof.pipeline.runtime import own_cores
from levelproof.pipeline.store.files import write
from levelproof.pipeline.store.manifest import require_manifest

LEVELS, SEEDS, UPDATES, ATTEMPTS = (100, 1000, 5000), 2, 1000, 8
SAMPLED, GREEDY = "policy, sampled", "policy, greedy"
BASELINES = (
    "doing nothing",
    "random",
    "sticky random",
    "its own expert, 16k",
    "its own expert, 64k",
    "its own expert, 256k",
)
PLAIN, MIRRORED, LONGER = "", "mirrored", "twice the updates"  # kinds of clones
BLUE, GREEN, GREY = "#0072b2", "#009e73", "#777777"
COLUMNS = {  # of sealed levels: which of them count, who plays, and which of its rates
    "sampled, of all": (ALL, SAMPLED, "once"),
    "sampled, of solved": (SOLVED, SAMPLED, "once"),
    "greedy, of solved": (SOLVED, GREEDY, "once"),
    "best of 8, of solved": (SOLVED, SAMPLED, "best"),
}


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("split", type=Path, help="split to clone from, with enough solved levels")
    parser.add_argument("--levels", type=int, nargs="+", default=LEVELS, help="solved levels to clone from")
    parser.add_argument("--seeds", type=int, default=SEEDS, help=f"policies per number of levels (default: {SEEDS})")
    parser.add_argument("--mirrored", type=int, nargs="*", default=(), help="numbers of levels to clone mirrored, too")
    parser.add_argument(
        "--longer", type=int, nargs="*", default=(), help="numbers to clone with twice the updates, too"
    )
    parser.add_argument("--updates", type=int, default=UPDATES, help=f"updates of each policy (default: {UPDATES})")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="further settings of every clone")
    parser.add_argument("--measured", type=int, default=2048, help="sealed levels to measure on (default: 2048)")
    parser.add_argument("--folder", type=Path, default=Path("cloning"), help="where policies are kept")


def run(args: argparse.Namespace) -> Report:
    table = require_manifest(args.split, ["level_id", "label"]).table
    solved = table["level_id"].to_numpy()[np.array(table["label"].to_pylist()) == "solved"]
    if max((*args.levels, *args.mirrored, *args.longer)) > len(solved):
        raise UserError(f"{args.split} has {len(solved)} solved levels: choose fewer with --levels.")
    size = name_of(levelproof.open(args.split).size)
    page = "cloning" if size == "s" else f"cloning_{size}"
    counts_of = {PLAIN: args.levels, MIRRORED: args.mirrored, LONGER: args.longer}
    kinds = [(variant, count) for variant, counts in counts_of.items() for count in counts]
    # Seed after seed, so that a run that is stopped leaves whole curves; of variants, the first one alone
    runs = [(*kind, seed) for seed in range(args.seeds) for kind in kinds if not (seed and kind[0])]
    with ThreadPoolExecutor(len(own_cores())) as threads:
        results = [*threads.map(lambda one: measured(args, size, int(solved[one[1] - 1]), *one), runs)]
    rows = [row_of(kind, [each for each in results if (each["variant"], each["levels"]) == kind]) for kind in kinds]
    head = ("cloned from", "seeds", "core-seconds", *COLUMNS, "sampled, on levels cloned from")
    counts = {name: f"{rates['random']['levels']:,}" for name, rates in results[0]["sealed"].items()}
    title = f"Share of sealed levels of {size} solved, with 95% intervals over levels; of several seeds, both are means"
    players = results[0]["sealed"]
    others = [
        [name, *(interval_text(players[levels][name][key]) for levels, key in ((ALL, "once"), (SOLVED, "once"),
                                                                              (SOLVED, "best")))]
        for name in BASELINES if name in players[ALL]
    ]  # fmt: skip
    settings, seeds = "".join(f" `{setting}`" for setting in args.set), by_seed(results, kinds)
    notes = [
        f"*Of all*: {counts[ALL]} levels, of which some cannot be solved; *of solved*: the {counts[SOLVED]} that are "
        "labelled solved. One attempt at each level, or the best of 8.",
        f"Each policy took {args.updates:,} updates{', with' * bool(settings)}{settings}, or twice as many where its "
        "row says so. A tenth of the levels that it was cloned from were kept from training, for validation. "
        "*Mirrored*: with `mirror=true`. Core-seconds are those of the clone, with compiling, reading and validation, "
        "and without those of the data; since 2026-11-29 [they are fewer](../tried/chunks.md). The last "
        "column plays at most 1,024 of the levels, that tenth included. Every "
        "policy is the average of its last updates, not the best of its validations: few levels are passed over "
        "hundreds of times, and an earlier end might suit them better.",
        f"Points that ten times the levels add to *sampled, of solved*: {'; '.join(gains(results, PLAIN))}"
        f"{''.join(f'; with {LONGER} {gain}' for gain in gains(results, LONGER))}. Where new levels are solved nearly "
        "as often as those cloned from, more levels cannot help much: the updates, the network or the method set the "
        "limit.",
        *[f"*Sampled, of solved*, seed by seed, in percent: {seeds}."] * bool(seeds),
        "Each policy was measured on sealed levels once, here.",
    ]
    second = Table(
        ("baseline", "of all", "of solved", "of solved, best of 8"), others,
        "The same levels, with 95% intervals over levels",
    )  # fmt: skip
    notes += [f"![Share of levels solved in one attempt, against the number of levels cloned from]({page}.svg)"]
    return Report(
        f"Cloning against the number of levels: {size}", results, [Table(head, rows, title), second], notes,
        plots={f"{page}.svg": lambda path: draw(path, results)}, page=page,
    )  # fmt: skip


def measured(args: argparse.Namespace, size: str, last: int, variant: str, count: int, seed: int) -> dict[str, Any]:
    """Clone one policy from the first `count` solved levels, the last of which has id `last`; measure it."""
    policy = args.folder / "-".join((size, str(count), str(seed), *variant.split()[:1]))
    chosen = f"label = 'solved' AND level_id <= {last}"
    updates = f"train.updates={args.updates * (2 if variant == LONGER else 1)}"
    settings = f"where={chosen}", updates, f"seed={seed}", *["mirror=true"] * (variant == MIRRORED), *args.set
    command("clone", args.split, "-o", policy, *settings)
    words = "--attempts", str(ATTEMPTS)
    sealed = kept(policy / "sealed.json", policy, *words, "--size", size, "--levels", args.measured)
    seen = kept(policy / "seen.json", policy, *words, "--on", args.split, "--where", chosen, "--levels", "1024")
    return {"levels": count, "variant": variant, "seed": seed, "sealed": sealed, "seen": seen,
            "core_seconds": lines_of(policy)[-1]["bc/core_seconds"]}  # fmt: skip


def kept(file: Path, policy: Path | str, *words: Any) -> dict[str, Any]:
    """Return an evaluation's rates, from its file if a run of the same arguments, weights and versions made it."""
    weights = policy_folder(policy) / WEIGHTS  # an agent in a Python file has none
    told = hashlib.sha256(repr((ENGINE_VERSION, SAMPLER_VERSION, *map(str, words))).encode())
    told.update(weights.read_bytes() if weights.exists() else b"")
    file = file.with_stem(f"{file.stem}-{told.hexdigest()[:8]}")
    if not file.exists():
        write(file, command("evaluate", policy, *words, "--json").encode())
    return json.loads(file.read_text())["levels"][0]["of"]


def slug(name: str) -> str:
    """Return a name as the files and folders of a benchmark have it."""
    return re.sub("[ :,=]+", "-", name)


def lines_of(policy: Path) -> list[dict[str, float]]:
    """Return the lines of a run's metrics; none if it has not begun."""
    file = policy / "metrics.jsonl"
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def command(*words: Any) -> str:
    """Run a command; return its output. Raise Failure with the last line of its errors if it fails."""
    return timed_command(*words)[0]


def timed_command(*words: Any) -> tuple[str, float]:
    """Run a command as `command` does; return its output, and the CPU seconds of its process."""
    return timed_process(f"levelproof {words[0]}", [sys.executable, "-m", "levelproof", *map(str, words)])


def timed_process(name: str, arguments: Sequence[str], **options: Any) -> tuple[str, float]:
    """Run a process with options of Popen; return its output, and the CPU seconds of it and its children.

    Raises:
        Failure: it fails; the message has its `name` and the last line of its errors.
    """
    with tempfile.TemporaryFile("w+") as output, tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(arguments, stdout=output, stderr=errors, text=True, **options)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        for file in (output, errors):
            file.seek(0)
        if process.returncode:
            lines = errors.read().strip().splitlines() or [f"exit code {process.returncode}"]
            raise Failure(f"{name} failed: {lines[-1]}")
        return output.read(), used.ru_utime + used.ru_stime


def timed_split(out: Path, *words: Any) -> float:
    """Generate a split in `out`, unless an earlier run has; return the CPU seconds that it took.

    A split's own ledger has seconds of a clock, which other work on the machine makes longer.

    Raises:
        UserError: an earlier run made another split there.
        Failure: a run that was stopped has left a part of the levels, whose seconds nobody knows.
    """
    file, told = out.with_suffix(".json"), " ".join(map(str, words))
    if not file.exists():
        if out.exists():
            raise Failure(f"{out} was left by a run that was stopped: remove it, so that its search counts as a whole.")
        seconds = timed_command("generate", *words, f"out={out}", "executor=inline")[1]
        write(file, json.dumps({"settings": told, "core_seconds": seconds}).encode())
    made = json.loads(file.read_text())
    if made["settings"] != told:
        raise UserError(f"{out} was made with {made['settings']}, not with {told}: choose another --folder.")
    return made["core_seconds"]


def row_of(kind: tuple[str, int], results: list[dict[str, Any]]) -> list[str]:
    variant, count = kind
    ways = [("sealed", *way) for way in COLUMNS.values()] + [("seen", ALL, SAMPLED, "once")]
    rates = [[each[where][levels][player][key] for each in results] for where, levels, player, key in ways]
    seconds = np.mean([each["core_seconds"] for each in results])
    return [
        ", ".join(filter(None, (f"{count:,}", variant))),
        str(len(results)),
        f"{seconds:,.0f}",
        *map(mean_text, rates),
    ]


def by_seed(results: list[dict[str, Any]], kinds: list[tuple[str, int]]) -> str:
    """Say how much training's own chance matters: the rates of each kind of clone, seed by seed."""
    told = []
    for kind in kinds:
        rates = [once_of(each) for each in results if (each["variant"], each["levels"]) == kind]
        if len(rates) > 1:
            told.append(f"{kind[1]:,}: {', '.join(f'{rate:.1f}' for rate in rates)}")
    return "; ".join(told)


def once_of(result: dict[str, Any]) -> float:
    """Return the main rate of a policy in percent: one sampled attempt at solved sealed levels."""
    return 100 * result["sealed"][SOLVED][SAMPLED]["once"]["rate"]


def mean_text(rates: list[dict[str, Any]]) -> str:
    """Return the mean rate of several seeds, and the mean of their intervals over levels: it allows for no seeds."""
    return interval_text({name: np.mean([each[name] for each in rates], axis=0) for name in ("rate", "interval")})


def gains(results: list[dict[str, Any]], variant: str) -> list[str]:
    """Return what more levels add to clones of a variant, between each two neighbouring numbers of them."""
    rates: dict[int, list[float]] = {}
    for each in results:
        if each["variant"] == variant:
            rates.setdefault(each["levels"], []).append(once_of(each))
    means = [(count, float(np.mean(some))) for count, some in sorted(rates.items())]
    return [
        f"from {few:,} to {many:,}, {(of_many - of_few) / np.log10(many / few):+.1f}"
        for (few, of_few), (many, of_many) in itertools.pairwise(means)
    ]


def interval_text(rate: dict[str, Any]) -> str:
    low, high = rate["interval"]
    return f"{rate['rate']:.1%} ({low:.1%} to {high:.1%})"


def draw(path: Path, results: list[dict[str, Any]]) -> None:
    """Plot the rates of sampled actions on sealed and on known levels, a point per policy, beside the baselines."""
    plt = pyplot()

    figure, axes = plt.subplots(figsize=(6, 3.6), layout="constrained")
    results = [each for each in results if not each["variant"]]
    counts = sorted({each["levels"] for each in results})
    for where, levels, colour, name in (
        ("seen", ALL, GREEN, "levels cloned from"),
        ("sealed", SOLVED, BLUE, "levels never seen"),
    ):
        rate = lambda each, where=where, levels=levels: 100 * each[where][levels][SAMPLED]["once"]["rate"]
        axes.plot([each["levels"] for each in results], [*map(rate, results)], "o", color=colour, markersize=3)
        means = [np.mean([rate(each) for each in results if each["levels"] == count]) for count in counts]
        axes.plot(counts, means, color=colour, label=name)
    for player in (*BASELINES[1:3], BASELINES[-1]):
        rate = 100 * results[0]["sealed"][SOLVED][player]["once"]["rate"]
        axes.axhline(rate, color=GREY, linewidth=0.7, linestyle=":")
        axes.annotate(player, (1, rate), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=7,
                      color=GREY)  # fmt: skip
    axes.set(xscale="log", ylim=(0, None), xlabel="solved levels cloned from", ylabel="solved in one attempt, %")
    axes.legend(frameon=False, loc="upper right")
    save(figure, path)
