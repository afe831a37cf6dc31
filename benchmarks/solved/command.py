"""Command line of `python -m benchmarks solved`.

Level ids below 1,000,000 are for tuning, those above for reports.
"""

import argparse
from dataclasses import asdict
from pathlib import Path

from benchmarks.report import Report
from benchmarks.solved import larger, measure, original, plot, tables
from benchmarks.solved.results import FILE, Header, Results, made, read
from benchmarks.solved.variants import VARIANTS
from levelproof.configs.convert import plain
from levelproof.configs.numbers import parse_count
from levelproof.experts.config import check_budget
from levelproof.levelgen.level import size_of
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.look.figures import Share

PLOTTED = (
    "s-1M-alone",
    "s-4M-alone",
    "m-1M-alone",
    "m-4M-alone",
    "l-4M-alone",
)  # groups whose curves are plotted by default
PLOT = "solved.svg"
LARGER = "; the samples in the first two tables: 2026-11-25 to 28, sampler 2"


def register(parser: argparse.ArgumentParser) -> None:
    names = "\n".join(f"  {name:16}{variant.text}" for name, variant in VARIANTS.items())
    parser.description = "Tables of the levels that variants solve; with --variant, missing levels are trained first."
    parser.epilog = f"variants:\n{names}\n\nexample: python -m benchmarks solved --variant default --size s"
    parser.add_argument(
        "groups", nargs="*", metavar="SIZE-BUDGET-VARIANT", help="groups to show, such as s-64k-default"
    )
    parser.add_argument("--variant", choices=list(VARIANTS), metavar="NAME", help="variant to train; see below")
    parser.add_argument("--size", default="s", help="size of the levels to train (default: s)")
    parser.add_argument("--budget", default="64k", help="env steps of an expert (default: 64k)")
    parser.add_argument("--levels", default="512", help="number of levels to train (default: 512)")
    parser.add_argument("--first", type=int, default=1_000_000, help="id of the first (default: 1000000)")
    parser.add_argument("--jobs", type=int, default=0, help="processes, one core each (default: one per core)")
    parser.add_argument("--again", action="store_true", help="replace results from other settings")
    parser.add_argument("--results", type=Path, default=FILE, help="file (default: benchmarks/results/solved.parquet)")


def run(args: argparse.Namespace) -> Report:
    trained = train(args) if args.variant else None
    results = read(args.results)
    named = {each.header.name: each for each in results}
    if missing := [name for name in args.groups if name not in named]:
        raise UserError(f"{args.results} has no results of {', '.join(missing)}: train them with --variant.")
    if args.groups:
        results = [named[name] for name in args.groups]
    elif trained:
        results = [each for each in results if (each.header.size, each.header.budget) == (trained.size, trained.budget)]
    if not results:
        raise UserError(f"{args.results} has no results: train some with --variant.")
    return report_of(results, whole=not (args.groups or trained))


def train(args: argparse.Namespace) -> Header:
    """Train the variant's missing levels.

    Raises:
        UserError: a number or the size is invalid, or results are from other settings.
    """
    budget, levels = parse_count(args.budget, "--budget"), parse_count(args.levels, "--levels")
    variant = VARIANTS[args.variant]
    try:
        check_budget(budget, variant.procedure.expert, variant.procedure.stop)
    except ValueError as error:
        raise UserError(f"--{error}.") from None
    if args.first < 0:
        raise UserError(f"--first is {args.first}: level ids are 0 and above.")
    try:
        size_of(args.size)
    except ValueError as error:
        raise UserError(f"--{error}.") from None
    header = Header(args.variant, args.size, budget, plain(variant.procedure))
    worker = original.work if variant.original else measure.work
    level_ids = range(args.first, args.first + levels)
    measure.measure(header, variant, level_ids, args.jobs, worker, args.again, args.results)
    return header


def report_of(results: list[Results], whole: bool) -> Report:
    """Report on all results with curves of PLOTTED, or on some results with all their curves."""
    drawn = [each for each in results if (each.header.name in PLOTTED if whole else plot.has_curve(each))]
    curves = plot.ordered(drawn)
    return Report(
        title="How many levels are solved",
        results=[{"groups": [document(each) for each in results]}],
        tables=[
            *([larger.larger_samples(), larger.paired()] if whole else []),
            *tables.tables(results),
            *([plot.table(curves)] if curves else []),
        ],
        notes=[
            *([f"![How the unsolved share falls with budget]({PLOT})"] if curves else []),
            tables.variants_of(results),
            "*Undecided* levels are neither trivial nor proved unsolvable. Tables with a column *variant* compare "
            f"variants on the same levels: rows of `default` with fewer than {tables.ENOUGH:,} undecided levels, "
            "marked *few*, are not to be quoted for the solved share itself. Levels of these tables are of sampler 1, "
            "whose numbers differ from today's in the last bits.",
            "*An expert reaches the goal by itself* if its witness is its own, or if attempts of its last evaluation "
            "reach it; a search's witness replaces an expert's that survives fewer than half of its replays. Success "
            "rates are of first episodes; - means not measured.",
        ],
        plots={PLOT: lambda path: plot.draw(curves, path)} if curves else {},
        made=made(results) + LARGER * whole,
    )


def document(each: Results) -> dict:
    """Summarise results as a JSON document."""
    trained, solved = len(each.trained), len(each.solved())
    header = {name: x for name, x in asdict(each.header).items() if name != "config"}
    seconds = sum(row["core_seconds"] for row in each.rows.values())
    share = {"share": solved / trained if trained else None, "interval": Share(solved, trained).interval}
    counts = {"levels": len(each.rows), "with_expert": trained, "solved": solved, "core_seconds": seconds}
    return header | counts | share
