"""The README's commands as a newcomer types them: a fresh clone, a fresh environment, nothing compiled yet."""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.report import Report, Table
from levelproof.pipeline.errors import Failure

ROOT = Path(__file__).parent.parent
INSTALL, GENERATE = "pip install -e .", "levelproof generate"
INSTALL_DEV, TEST = 'pip install -e ".[dev]"', "pytest"


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--python", default=sys.executable, help="Python that makes the environment (default: this one)"
    )
    parser.add_argument("--tests", action="store_true", help="run the tests, too")


def run(args: argparse.Namespace) -> Report:
    commands = [INSTALL, GENERATE, GENERATE, *((INSTALL_DEV, TEST) if args.tests else ())]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        environment = _fresh(folder, args.python)
        results = [_timed(command, folder / "clone", environment) for command in commands]
    return Report(
        title="The README's commands",
        results=results,
        tables=[Table(("command", "wall time", "output"), [_row(result) for result in results])],
        notes=[
            "In order, in a fresh clone and a fresh environment: packages come from the index, and programs compile."
        ],
    )


def _fresh(folder: Path, python: str) -> dict[str, str]:
    """Clone the commit and make a virtual environment with an empty cache; return its environment variables."""
    subprocess.run(["git", "clone", "--quiet", ROOT, folder / "clone"], check=True)
    subprocess.run([python, "-m", "venv", folder / "environment"], check=True)
    ours = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "LEVELPROOF", "RAY"))}
    path = f"{folder / 'environment' / 'bin'}{os.pathsep}{ours['PATH']}"
    return ours | {"PATH": path, "LEVELPROOF_CACHE_DIR": str(folder / "cache")}


def _timed(command: str, folder: Path, environment: dict[str, str]) -> dict[str, Any]:
    """Run a command; return its wall time, s, and the line that sums it up.

    Raises:
        Failure: the command fails.
    """
    start = time.perf_counter()
    done = subprocess.run(command, cwd=folder, env=environment, shell=True, capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - start
    if done.returncode:
        raise Failure(f"`{command}` fails with {done.returncode}:\n{(done.stdout + done.stderr)[-2000:]}")
    lines = [line for line in done.stdout.splitlines() if re.search(r"\d+ (solved|passed|levels are there)", line)]
    return {"command": command, "seconds": seconds, "said": lines[-1].strip("= ") if lines else ""}


def _row(result: dict[str, Any]) -> tuple[str, str, str]:
    minutes, seconds = divmod(round(result["seconds"]), 60)
    return f"`{result['command']}`", f"{minutes} min {seconds} s" if minutes else f"{seconds} s", result["said"]
