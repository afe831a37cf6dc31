"""The command `python -m benchmarks NAME`, which runs one benchmark.

A benchmark is a module with `register`, which adds its arguments, and `run`, which measures. Only the chosen one is
imported, so that `--help` answers at once.
"""

import argparse
import subprocess
import sys
from collections.abc import Sequence
from importlib import import_module

from benchmarks.report import RESULTS, Report, Run, as_json, as_page, as_text
from levelproof.configs.errors import ConfigError
from levelproof.pipeline.errors import Exit, LevelproofError

BENCHMARKS = {  # name: (module, what it measures)
    "physics": ("benchmarks.physics", "env steps/s of both engines under random actions, without observations"),
    "experts": ("benchmarks.experts", "env steps/s of both programs in training one expert per level"),
    "parity": ("benchmarks.parity.command", "how far the physics differs from the reference's, and why"),
    "sampler": ("benchmarks.sampler", "levels/s of both samplers, and the seconds of their first calls"),
    "fidelity": ("benchmarks.fidelity", "whether our random levels are the reference's, statistic by statistic"),
    "solved": ("benchmarks.solved.command", "how many levels experts solve, how soon and at what cost"),
    "search": ("benchmarks.search", "how many more levels a longer search would solve"),
    "equal": ("benchmarks.equal", "learners at equal cost: what a core-hour gives, with and without data"),
    "teaching": (
        "benchmarks.teaching",
        "which data teaches best: witnesses by several procedures, teachers, demonstrations",
    ),
    "offline": ("benchmarks.offline", "offline reinforcement learning by TorchRL beside clones of the same levels"),
    "tuned": ("benchmarks.tuned", "what training on the handmade levels adds, and what it takes from scratch"),
    "late": ("benchmarks.late", "which levels only a long search solves, and how"),
    "prior": ("benchmarks.prior", "what attempts of a policy before the search would find and save"),
    "ppo": ("benchmarks.ppo", "env steps/s of reinforcement learning over many levels, on one core and on all"),
    "networks": (
        "benchmarks.networks",
        "multiply-adds of the experts' networks, and env steps/s of training with each",
    ),
    "kinds": ("benchmarks.kinds", "networks of policies: clones at equal core-seconds, and their FLOP/s"),
    "floor": ("benchmarks.floor", "what each stage of a physics step costs, and the floor of its arithmetic"),
    "scaling": ("benchmarks.scaling", "env steps/s against active contacts, and against bodies"),
    "observation": ("benchmarks.observation", "what the symbolic-flat observation costs beside the step"),
    "fresh": ("benchmarks.fresh", "random play on new levels at every reset, against a table of levels"),
    "cores": ("benchmarks.cores", "how much faster one process steps on all cores than on one"),
    "families": ("benchmarks.families", "how many levels of each distribution need no expert, and a sheet of each"),
    "portability": ("benchmarks.portability", "how many witnesses reach the goal in the reference"),
    "polish": ("benchmarks.polish", "how much polishing shortens witnesses, and how far masters are from that"),
    "handmade": ("benchmarks.handmade", "what it takes to label the reference's 74 handmade levels, one by one"),
    "storage": ("benchmarks.storage", "bytes per transition of each density, and trajectories/s written and read"),
    "plan": ("benchmarks.plan", "what `levelproof plan` forecasts for a job, against the job itself"),
    "rehearsal": ("benchmarks.rehearsal", "millions of levels on thousands of workers, under a simulated clock"),
    "night": ("benchmarks.night", "a long real run: seconds, bytes, files, and memory over time"),
    "manifest": ("benchmarks.manifest", "how long commands take to start on a split of millions of levels"),
    "gallery": ("benchmarks.gallery", "how soon a gallery of many levels appears, and how smoothly it scrolls"),
    "reader": ("benchmarks.reader", "trajectories/s of both readers on the same trajectories"),
    "seeds": ("benchmarks.seeds", "bytes of seeds, and transitions/s read from them and from a disk"),
    "workers": ("benchmarks.workers", "how much faster two workers are than one"),
    "cloning": ("benchmarks.cloning", "how cloned policies solve unseen levels, against the number of levels"),
    "agents": ("benchmarks.agents", "how policies play the levels of the reference's published agents"),
    "cold": ("benchmarks.cold", "how long the first levels take with nothing compiled, and the next ones"),
    "cost": ("benchmarks.cost", "what a solved level costs, and how many are solved, beside an earlier commit"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one benchmark; return the exit code: 0 done, 1 failed, 2 the command must change."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    args = parser(next((argument for argument in arguments if argument in BENCHMARKS), None)).parse_args(arguments)
    try:
        report = args.run(args)
        if report is not None:
            show(report, Run.now(args.benchmark, arguments, report), args)
        return Exit.FAILED if report and report.fault else Exit.DONE
    except (LevelproofError, ConfigError) as error:
        print(f"Error: {error}", file=sys.stderr)
        return getattr(error, "exit_code", Exit.INPUT)
    except subprocess.CalledProcessError as error:
        print(f"Error: {error}", file=sys.stderr)
        return Exit.FAILED
    except KeyboardInterrupt:
        print("Stopped.", file=sys.stderr)
        return Exit.INTERRUPTED


def parser(chosen: str | None = None) -> argparse.ArgumentParser:
    """Return the parser of all benchmarks; only the chosen one has its arguments."""
    whole = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Measure this program alone, or alternating with the reference (Kinetix 3.0.2) on the same "
        "machine, levels and actions. The reference runs in its own environment, created on first use in the cache "
        "folder (LEVELPROOF_CACHE_DIR); LEVELPROOF_ORACLE_PYTHON names a Python that already has it.",
        epilog="example: python -m benchmarks physics --size s --json",
    )
    names = whole.add_subparsers(dest="benchmark", metavar="BENCHMARK", required=True)
    for name, (module, subject) in BENCHMARKS.items():
        sub = names.add_parser(
            name,
            help=subject,
            description=f"{subject[0].upper()}{subject[1:]}.",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if name == chosen:
            benchmark = import_module(module)
            benchmark.register(sub)
            sub.set_defaults(run=benchmark.run)
            sub.add_argument("--json", action="store_true", help="print JSON")
            sub.add_argument("--write", action="store_true", help=f"write the page {RESULTS.name}/{name}.md")
    return whole


def show(report: Report, run: Run, args: argparse.Namespace) -> None:
    """Print a report and, with --write, write its page and plots."""
    print(as_json(report, run) if args.json else as_text(report, run))
    if args.write:
        RESULTS.mkdir(parents=True, exist_ok=True)
        for name, draw in report.plots.items():
            draw(RESULTS / name)
        (RESULTS / f"{report.page or args.benchmark}.md").write_text(as_page(report, run))
    if report.fault:
        print(f"Error: {report.fault}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
