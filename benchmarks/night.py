"""A long real run, generated, sealed and verified, with its memory and files over time."""

import argparse
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from benchmarks import oracle
from benchmarks.plan import measured
from benchmarks.plotting import pyplot, save
from benchmarks.report import Report, Table
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.layout import split_path

PLOT = "night.svg"
COLOURS = {"driver": "#0072b2", "workers": "#d55e00", "ray": "#777777"}  # Okabe and Ito
INTERVAL = 10.0  # s between samples
MAX_SAMPLES = 2000  # in the report; of more, every second, third, ... is shown


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("settings", nargs="*", help="more settings of generate")
    parser.add_argument("--levels", default="100k", help="number of levels (default: 100k)")
    parser.add_argument("--size", default="s")
    parser.add_argument("--budget", default="64k")
    parser.add_argument("--out", type=Path, help="folder to keep the split in (default: it is deleted)")
    parser.add_argument("--every", type=float, default=INTERVAL, metavar="SECONDS", help="time between memory samples")


def run(args: argparse.Namespace) -> Report:
    with tempfile.TemporaryDirectory() as folder:
        out = str(args.out or folder)
        split = split_path(out, args.budget, args.size)
        arguments = [f"size={args.size}", f"levels={args.levels}", f"budget={args.budget}", f"out={out}"]
        samples: list[dict[str, Any]] = []
        steps = {
            "generate": _timed(["generate", *arguments, *args.settings], samples, args.every, split),
            "seal": _timed(["seal", str(split)], samples, args.every, split),
            "verify": _timed(["verify", str(split)], samples, args.every, split),
        }
        workers = max(sample["worker_count"] for sample in samples)
        totals = measured(split, max(workers, 1), steps["generate"])
        status = json.loads(_levelproof("status", str(split), "--json"))
    memory = {kind: max(sample[kind] for sample in samples) for kind in COLOURS}
    generating = [sample for sample in samples if sample["step"] == "generate"]
    half = generating[len(generating) // 2 :]
    table = {
        "levels": f"{status['done']:,}",
        "workers": str(workers),
        **{f"{step}, s": f"{seconds:,.0f}" for step, seconds in steps.items()},
        "solved": f"{totals['solved']:,}",
        "core-seconds a solved level": f"{totals['seconds_per_solved']:.3g}" if totals["solved"] else "-",
        "bytes, sealed": f"{totals['bytes']:,}",
        "files, sealed": f"{totals['files']:,}",
        "maximum fragments": f"{max(sample['fragments'] for sample in samples):,}",
        **{f"maximum memory of {kind}, MiB": f"{value / 2**20:,.0f}" for kind, value in memory.items()},
        "driver's memory, second half of generate, MiB": " to ".join(
            f"{value / 2**20:,.0f}" for value in (half[0]["driver"], half[-1]["driver"])
        ),
    }
    shown = samples[:: -(-len(samples) // MAX_SAMPLES)]  # the maxima above are of all
    return Report(
        title=f"{args.levels} levels of size {args.size} at {args.budget}",
        results=[{**steps, **totals, "memory": memory, "samples": shown}],
        tables=[Table(("", ""), list(table.items()))],
        notes=[
            "`levelproof generate`, `seal` and `verify`, one after another. Memory is the RAM of processes, with "
            "shared pages counted once: of the command itself, of its workers, and of Ray's own processes.",
            f"![Memory, files and levels over time]({PLOT})",
        ],
        plots={PLOT: lambda path: draw(shown, path)},
    )


def _timed(arguments: Sequence[str], samples: list[dict[str, Any]], every: float, split: Path) -> float:
    """Run a command, sampling its processes at intervals; return its seconds."""
    oracle.log(f"levelproof {' '.join(arguments)}")
    start = time.time()
    command = [sys.executable, "-m", "levelproof", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=dict(oracle.our_environment()))
    over = threading.Event()

    def watch() -> None:
        while not over.is_set():
            samples.append({"time": time.time(), "step": arguments[0], **memory_of(process.pid), **parts_of(split)})
            over.wait(every)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        code = process.wait()
    finally:
        process.terminate()
        over.set()
        thread.join()
    if code:
        raise Failure(f"`levelproof {' '.join(arguments)}` ended with exit code {code}: see its message above.")
    return time.time() - start


def memory_of(driver: int) -> dict[str, int]:
    """Return the RAM of a command, of its workers and of its other descendants, bytes; shared pages are divided."""
    memory = {"driver": _memory(driver), "workers": 0, "ray": 0, "worker_count": 0}
    for pid in below(driver):
        title = process_file(pid, "cmdline").replace("\0", " ")
        is_worker = title.startswith("ray::WorkerActor")
        memory["workers" if is_worker else "ray"] += _memory(pid)
        memory["worker_count"] += is_worker
    return memory


def below(pid: int) -> list[int]:
    """List all descendants of a process."""
    tasks = Path(f"/proc/{pid}/task").glob("*")
    children = [int(child) for task in tasks for child in _read_path(task / "children").split()]
    return [pid for child in children for pid in (child, *below(child))]


def _memory(pid: int) -> int:
    for line in process_file(pid, "smaps_rollup").splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) * 1024
    return 0


def process_file(pid: int, name: str) -> str:
    return _read_path(Path(f"/proc/{pid}/{name}"))


def _read_path(path: Path) -> str:
    with suppress(OSError):  # the process has ended
        return path.read_text(errors="replace")
    return ""


def parts_of(split: Path) -> dict[str, int]:
    """Count a split's fragments and shards."""
    return {"fragments": len([*split.glob("manifest/[!.]*")]), "shards": len([*split.glob("shards/*")])}


def _levelproof(*arguments: str) -> str:
    command = [sys.executable, "-m", "levelproof", *arguments]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=dict(oracle.our_environment()))
    return done.stdout


def draw(samples: Sequence[Mapping[str, Any]], file: Path) -> None:
    plt = pyplot()

    figure, (left, right) = plt.subplots(1, 2, figsize=(8.6, 3.4), layout="constrained")
    minutes = [(sample["time"] - samples[0]["time"]) / 60 for sample in samples]
    for kind, colour in COLOURS.items():
        left.plot(minutes, [sample[kind] / 2**30 for sample in samples], color=colour, label=kind)
    left.set(xlabel="minutes", ylabel="memory, GiB", ylim=0)
    right.plot(minutes, [sample["fragments"] for sample in samples], color="#009e73", label="fragments")
    right.plot(minutes, [sample["shards"] for sample in samples], color="#777777", label="shards")
    right.set(xlabel="minutes", ylabel="in the split", ylim=0)
    steps = [i for i in range(1, len(samples)) if samples[i]["step"] != samples[i - 1]["step"]]
    for axes in (left, right):
        for i in steps:
            axes.axvline(minutes[i], color="#cccccc", linewidth=0.8)
        axes.legend(frameon=False)
        axes.grid(alpha=0.25, linewidth=0.5)
    save(figure, file)
