"""Presets of the distribution: a sheet of each, and the share of their levels that need no expert."""

import argparse
from pathlib import Path

import numpy as np

from benchmarks.report import Report, Table
from levelproof.configs.compose import compose_job, distributions
from levelproof.experts.verdict.before import facts_of
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.pictures.raster import write_png
from levelproof.levelgen.proofs import Proof
from levelproof.levelgen.sampling.sampler import Distribution, sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES
from levelproof.pipeline.look.sample import LEVELS, sheet_of
from levelproof.pipeline.runtime import prepare_jax

SHEET_SIZE = "l"
KINDS = ("trivial", "fails", "unsolvable")


def shares(distribution: Distribution, size: str, count: int) -> dict[str, float]:
    """Return the shares of levels that are trivial, that doing nothing fails, and that are proved unsolvable."""
    facts = facts_of(sample_levels(np.arange(count), SIZES[size], distribution), DEFAULT_RULES)
    flags = facts.reaches, facts.fails, facts.proof != Proof.NONE
    return {name: float(x.mean()) for name, x in zip(KINDS, flags, strict=True)}


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--levels", type=int, default=2_000, help="levels per size and preset (default: 2,000)")
    parser.add_argument("--sheets", type=Path, help="folder to write a sheet levels-NAME.png of each preset to")


def run(args: argparse.Namespace) -> Report:
    prepare_jax()
    if args.sheets:
        args.sheets.mkdir(parents=True, exist_ok=True)
    results = []
    for name, distribution in distributions().items():
        if args.sheets:
            job = compose_job([f"size={SHEET_SIZE}", f"distribution={name}", f"levels={LEVELS}"])
            write_png(sheet_of(job), args.sheets / f"levels-{name}.png")
        of_sizes = {size: shares(distribution, size, args.levels) for size in SIZES}
        results.append({"distribution": name, "levels": args.levels, "shares": of_sizes})
    rows = [
        [f"`{result['distribution']}`", *(f"{x:.1%}" for shares in result["shares"].values() for x in shares.values())]
        for result in results
    ]
    head = [f"{size}: {what}" for size in SIZES for what in KINDS]
    return Report(
        title="Levels that need no expert, by distribution",
        results=results,
        tables=[Table(("distribution", *head), rows)],
        notes=[f"Shares of {args.levels:,} levels of each size and distribution."],
    )
