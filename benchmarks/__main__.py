"""`python -m benchmarks NAME`: everything that measures, each by its name.

A benchmark is a module with `register`, which adds its words, and `run`, which measures. It is imported only when it
is asked for: `--help` answers at once.
"""

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module

from benchmarks.report import RESULTS, Report, Run, as_json, as_page, as_text
from levelproof.configs.errors import ConfigError
from levelproof.pipeline.errors import Exit, LevelproofError

BENCHMARKS = {  # name: (module, what it measures)
    "physics": ("benchmarks.physics", "env steps/s of both engines under random actions, without observations"),
    "experts": ("benchmarks.experts", "env steps/s of both programs in training one expert per level"),
    "parity": ("benchmarks.parity.command", "how far the physics is from the reference's, and why"),
    "sampler": ("benchmarks.sampler", "levels/s of both samplers, and the seconds of their first calls"),
    "fidelity": ("benchmarks.fidelity", "whether our random levels are the reference's, statistic by statistic"),
    "solved": ("benchmarks.solved.command", "how many levels experts solve, how soon and at what cost"),
    "search": ("benchmarks.search", "how much a longer search would find"),
    "training": ("benchmarks.training", "env steps/s of rollout, update, and the program that does both"),
    "networks": ("benchmarks.networks", "multiply-adds of the networks, and env steps/s of training with each"),
    "floor": ("benchmarks.floor", "what each stage of a physics step costs, and the floor of its arithmetic"),
    "scaling": ("benchmarks.scaling", "env steps/s against active contacts, and against bodies"),
    "observation": ("benchmarks.observation", "what the symbolic-flat observation costs beside the step"),
    "cores": ("benchmarks.cores", "how much faster one process steps on all cores than on one"),
    "families": ("benchmarks.families", "how many levels of each distribution need no expert, and a sheet of each"),
    "portability": ("benchmarks.portability", "how many witnesses reach the goal in the reference"),
    "polish": ("benchmarks.polish", "how short search around a witness makes it, and how far masters are from that"),
    "handmade": ("benchmarks.handmade", "what it takes to label the reference's 74 handmade levels, one by one"),
    "storage": ("benchmarks.storage", "bytes per transition of each density, and trajectories/s written and read"),
    "plan": ("benchmarks.plan", "what `levelproof plan` says of a job, against the job itself"),
    "rehearsal": ("benchmarks.rehearsal", "millions of levels on thousands of workers, under a simulated clock"),
    "night": ("benchmarks.night", "a long run for real: seconds, bytes, files, and memory over time"),
    "manifest": ("benchmarks.manifest", "how long commands take to start on a split of millions of levels"),
    "gallery": ("benchmarks.gallery", "how soon a gallery of many levels shows, and how smoothly it scrolls"),
    "reader": ("benchmarks.reader", "trajectories/s of both readers on the same trajectories"),
    "workers": ("benchmarks.workers", "how much faster two workers are than one, and what a thousand cost the driver"),
    "readme": ("benchmarks.readme", "the README's commands in a fresh clone and environment"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one benchmark; its exit code: 0 done, 1 failed, 2 something to change in the command."""
    words = list(sys.argv[1:] if argv is None else argv)
    given = parser(next((word for word in words if word in BENCHMARKS), None)).parse_args(words)
    try:
        report = given.run(given)
        if report is not None:
            tell(report, Run.now(given.benchmark, words, report), given)
        return Exit.FAILED if report and report.fault else Exit.DONE
    except (LevelproofError, ConfigError) as error:
        print(f"Error: {error}", file=sys.stderr)
        return getattr(error, "exit_code", Exit.INPUT)
    except KeyboardInterrupt:
        print("Stopped.", file=sys.stderr)
        return Exit.INTERRUPTED


def parser(asked: str | None = None) -> argparse.ArgumentParser:
    """Of all benchmarks; only the one that is asked for knows its words."""
    of_all = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Measure this program, by itself and beside the reference (Kinetix 3.0.2) on the same machine, "
        "levels and actions, in turns. The reference runs in an environment of its own, made on first use in the "
        "cache folder (LEVELPROOF_CACHE_DIR); LEVELPROOF_ORACLE_PYTHON names a Python that has it already.",
        epilog="example: python -m benchmarks physics --size s --json",
    )
    names = of_all.add_subparsers(dest="benchmark", metavar="BENCHMARK", required=True)
    for name, (module, does) in BENCHMARKS.items():
        of_one = names.add_parser(
            name,
            help=does,
            description=f"{does[0].upper()}{does[1:]}.",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if name == asked:
            benchmark = import_module(module)
            benchmark.register(of_one)
            of_one.set_defaults(run=benchmark.run)
            of_one.add_argument("--json", action="store_true", help="print JSON")
            of_one.add_argument("--write", action="store_true", help=f"write {RESULTS.name}/{name}.md, all of it")
    return of_all


def tell(report: Report, run: Run, given: argparse.Namespace) -> None:
    """Print what was found, and write its page if that was asked for."""
    print(as_json(report, run) if given.json else as_text(report, run))
    if given.write:
        RESULTS.mkdir(parents=True, exist_ok=True)
        for name, draw in report.plots.items():
            draw(RESULTS / name)
        (RESULTS / f"{given.benchmark}.md").write_text(as_page(report, run))
    if report.fault:
        print(f"Error: {report.fault}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
