"""How many levels experts solve, how soon and at what cost: our defaults, variants of them, and the reference's PPO.

    python -m benchmarks.solved run --size s --levels 512 --first 1000000 --budget 64k --variant NAME
    python -m benchmarks.solved table FILES... [--write docs/experts.md]
    python -m benchmarks.solved plot FILES... --out docs/unsolved-by-budget.svg [--write docs/experts.md]

`run` appends a line per level to a file and skips the levels that are there: run it again to go on, or for more levels.
The variant `original` runs in the reference's own environment, made on first use as for `python -m benchmarks`.
Levels below 1,000,000 are for tuning, those above for reports.
"""

import argparse
import sys
from pathlib import Path

from benchmarks.document import between_marks
from benchmarks.solved import measure, original, plot, tables
from benchmarks.solved.results import Header, count, read_all
from benchmarks.solved.variants import VARIANTS
from configs.convert import plain
from configs.errors import ConfigError
from configs.numbers import parse_count
from levelgen.level import size_of
from pipeline.errors import Exit, LevelproofError, UserError

RESULTS = Path(__file__).parent.parent / "results"


def main() -> int:
    given = parser().parse_args()
    try:
        given.command(given)
    except (ConfigError, LevelproofError) as error:
        print(error, file=sys.stderr)
        return error.exit_code if isinstance(error, LevelproofError) else Exit.INPUT
    except KeyboardInterrupt:
        print("Stopped; run the same command again to go on.", file=sys.stderr)
        return Exit.INTERRUPTED
    return 0


def parser() -> argparse.ArgumentParser:
    of_all = argparse.ArgumentParser(prog="python -m benchmarks.solved", description=(__doc__ or "").split("\n\n")[0])
    commands = of_all.add_subparsers(required=True)
    names = "\n".join(f"  {name:16}{variant.text}" for name, variant in VARIANTS.items())
    raw = argparse.RawDescriptionHelpFormatter
    of_run = commands.add_parser("run", help="train the levels", epilog=f"variants:\n{names}", formatter_class=raw)
    of_run.set_defaults(command=run)
    of_run.add_argument("--size", default="s", help="of the levels (default: s)")
    of_run.add_argument("--levels", default="512", help="how many (default: 512)")
    of_run.add_argument("--first", type=int, default=1_000_000, help="id of the first (default: 1000000)")
    of_run.add_argument("--budget", default="64k", help="env steps of an expert (default: 64k)")
    of_run.add_argument("--variant", default="ours", choices=list(VARIANTS), metavar="NAME", help="see below")
    of_run.add_argument("--jobs", type=int, default=0, help="processes, a core each (default: one per core)")
    of_run.add_argument("--out", type=Path, help="file (default: benchmarks/results/SIZE-BUDGET-NAME.jsonl)")
    of_table = commands.add_parser("table", help="compare the variants of files")
    of_table.set_defaults(command=table)
    of_plot = commands.add_parser("plot", help="how the unsolved share falls with budget")
    of_plot.set_defaults(command=curve)
    of_plot.add_argument("--out", type=Path, required=True, help="file of the plot, .svg")
    for command in (of_table, of_plot):
        command.add_argument("files", type=Path, nargs="+", help="files that `run` has written")
        command.add_argument("--write", type=Path, help="document to put the table into, between its marks")
    return of_all


def run(given: argparse.Namespace) -> None:
    budget, levels = parse_count(given.budget, "--budget"), parse_count(given.levels, "--levels")
    variant = VARIANTS[given.variant]
    if budget < variant.expert.steps_per_update:
        raise UserError(f"--budget is {budget}: one update takes {variant.expert.steps_per_update} env steps.")
    if given.first < 0:
        raise UserError(f"--first is {given.first}: level ids are 0 and above.")
    try:
        size_of(given.size)
    except ValueError as error:
        raise UserError(f"--{error}.") from None
    settings = {"expert": plain(variant.expert), "stop": plain(variant.stop)}
    header = Header(given.variant, given.size, budget, settings)
    out = given.out or RESULTS / f"{given.size}-{count(budget)}-{given.variant}.jsonl"
    worker = original.work if variant.original else measure.work
    measure.measure(header, variant, range(given.first, given.first + levels), out, given.jobs, worker)


def table(given: argparse.Namespace) -> None:
    put(tables.tables(read_all(given.files)), tables.MARK, given.write)


def curve(given: argparse.Namespace) -> None:
    results = plot.checked(read_all(given.files))
    plot.draw(results, given.out)
    put(plot.table(results), plot.MARK, given.write)


def put(made: str, mark: str, document: Path | None) -> None:
    """Show a table, or put it into a document.

    Raises:
        UserError: the document is not there.
    """
    if document is None:
        print(made)
        return
    if not document.is_file():
        raise UserError(f"{document} is not there: make it, with the lines <!-- {mark} --> and <!-- end of {mark} -->.")
    document.write_text(between_marks(document.read_text(), mark, made))


if __name__ == "__main__":
    sys.exit(main())
