"""Start-up time and memory of commands on a sealed split of millions of levels.

The split is synthetic: resampled rows of the committed reference manifest with ids, hashes, signatures and commands of
their own; shards with as many files as sealed ones, of the same size but empty.
"""

import argparse
import json
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from benchmarks import oracle
from benchmarks.report import Report, Table
from levelproof.configs.compose import compose_job
from levelproof.configs.numbers import parse_count
from levelproof.experts.steps import Seconds
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.store.columns import COLUMNS
from levelproof.pipeline.store.layout import new_attempt, split_path, unit_name
from levelproof.pipeline.store.manifest import begin_fragment, require_manifest, write_fragment
from levelproof.pipeline.store.merge import FILE_BYTES
from levelproof.pipeline.store.seal import ROWS

REFERENCE = Path(__file__).parent.parent / "manifests" / "128k-s.parquet"
MAX_SECONDS, MAX_BYTES = 10, 2 * 2**30  # targets for each command
MAX_ENTRIES, MAX_FILES = 10_000, 20_000  # targets for one folder, and for the whole split
TRAJECTORY = 12_500  # bytes of one trajectory of size s
ALIKE = 200  # every 200th level is a near duplicate of the next
ADDED_LEVELS = 2**17  # levels that `generate` would add
ARRAYS = ("dyn32", "dyn8", "act", "lvl32", "lvl8")
CONDITION = "label = 'solved' AND steps_to_goal < 64"
OPEN = f"import levelproof, sys; print(len(levelproof.open(sys.argv[1], where={CONDITION!r})))"


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--levels", default="6M", help="levels of the split (default: 6M)")
    parser.add_argument("--repeats", type=int, default=1, help="runs of each command; the slowest counts (default: 1)")
    parser.add_argument("--split", type=Path, help="keep the split in this folder, or reuse the one in it")


def run(args: argparse.Namespace) -> Report:
    levels = parse_count(args.levels, "levels")
    folder = args.split or Path(tempfile.mkdtemp(prefix="levelproof-"))
    try:
        split = split_path(str(folder), "128k", "s")
        if not split.exists():
            made_split(folder, levels)
        elif (there := len(require_manifest(split, []).level_ids)) != levels:
            raise UserError(f"{split} has {there:,} levels: pass --levels {there}, or another --split.")
        results = [
            measured(name, arguments, args.repeats) for name, arguments in commands(folder, split, levels).items()
        ]
        files = [Path(path) / name for path, _, names in os.walk(split) for name in names]
        entries = max(Counter(path.parent for path in [*files, *split.rglob("*/")]).values())
    finally:
        if not args.split:
            shutil.rmtree(folder)
    worst = [result["name"] for result in results if result["seconds"] > MAX_SECONDS or result["bytes"] > MAX_BYTES]
    faults = [f"{', '.join(worst)}: more than {MAX_SECONDS} s or {MAX_BYTES / 2**20:,.0f} MiB."] if worst else []
    if len(files) > MAX_FILES or entries > MAX_ENTRIES:
        faults.append(f"More than {MAX_FILES:,} files, or {MAX_ENTRIES:,} entries in a folder.")
    head = ("command", "seconds", "core-seconds", "peak memory, MiB")
    numbers = lambda result: (
        f"{result['seconds']:.1f}",
        f"{result['core_seconds']:.1f}",
        f"{result['bytes'] / 2**20:,.0f}",
    )
    return Report(
        title="Manifests of millions of levels",
        results=[*results, {"name": "layout", "files": len(files), "largest_folder": entries}],
        tables=[Table(head, [(result["name"], *numbers(result)) for result in results])],
        notes=[
            f"Whole processes on a sealed split of {levels:,} levels, with {ADDED_LEVELS:,} more to generate, its "
            f"files in the page cache. It has {len(files):,} files, and its largest folder {entries:,} entries. The "
            f"target is {MAX_SECONDS} s and {MAX_BYTES / 2**20:,.0f} MiB for each, {MAX_FILES:,} files, and "
            f"{MAX_ENTRIES:,} entries.",
        ],
        fault=" ".join(faults),
    )


def commands(folder: Path, split: Path, levels: int) -> dict[str, Sequence[str]]:
    return {
        "levelproof status": ("-m", "levelproof", "status", str(split)),
        "levelproof inspect": ("-m", "levelproof", "inspect", str(split)),
        f'levelproof inspect --where "{CONDITION}"': ("-m", "levelproof", "inspect", str(split), "--where", CONDITION),
        "levelproof generate, until the first unit": (
            "-m", "benchmarks.ours.start", f"out={folder}", "size=s", "budget=128k", f"levels={levels + ADDED_LEVELS}",
        ),
        f'levelproof.open(where="{CONDITION}")': ("-c", OPEN, str(split)),
    }  # fmt: skip


def measured(name: str, arguments: Sequence[str], repeats: int) -> dict[str, Any]:
    """Run a process `repeats` times; return its worst wall seconds, core-seconds and peak memory."""
    seconds, cores, memory = [], [], []
    for _ in range(repeats):
        start = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, *arguments], env=dict(oracle.our_environment()), stdout=subprocess.DEVNULL
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        seconds.append(time.perf_counter() - start)
        cores.append(usage.ru_utime + usage.ru_stime)
        memory.append(usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024))
        if process.returncode:
            raise Failure(f"{name} fails with {process.returncode}.")
    return {"name": name, "seconds": max(seconds), "core_seconds": max(cores), "bytes": max(memory)}


def made_split(folder: Path, levels: int) -> None:
    """Write a sealed split of `levels` levels."""
    job = compose_job([f"out={folder}", "size=s", "budget=128k", f"levels={levels}"])
    split = split_path(job.out, job.budget, job.size)
    base, rng = pq.read_table(REFERENCE), np.random.default_rng(0)
    for first in range(0, levels, ROWS):
        ids = np.arange(first, min(first + ROWS, levels))
        attempt = new_attempt(split, unit_name(int(ids[0]), int(ids[-1])))
        begin_fragment(attempt)
        table = rows(base, ids, f"shards/{attempt.shard.name}", job.hash, rng)
        write_fragment(attempt, table, job.hash, job.results, sealed=True)
        hollow_shard(attempt.shard, table.num_rows - table.column("shard").null_count)
    note = {"command": "levelproof generate", "level_ids": [[0, levels - 1]], "config_hash": job.hash}
    (split / "job.json").write_text(json.dumps(note))


def rows(base: pa.Table, ids: np.ndarray, shard: str, config_hash: str, rng: np.random.Generator) -> pa.Table:
    """Make a row for each id: results are resampled from `base`, a level's own values are new."""
    table, count = base.take(rng.integers(0, base.num_rows, len(ids))), len(ids)
    solved = np.array(table.column("shard").is_valid())
    halves = [[f"n1:{secrets.token_hex(8)}" for _ in range(2)] for _ in ids]
    halves[:-1:ALIKE] = halves[1::ALIKE]
    own: Mapping[str, Any] = {
        "level_id": ids,
        "content_hash": [f"c1:{secrets.token_hex(16)}" for _ in ids],
        "signature": halves,
        "file": pa.nulls(count),
        "shard": [shard if has else None for has in solved],
        "row": np.where(solved, np.cumsum(solved) - 1, 0),
        "config_hash": [config_hash] * count,
        "seconds": pa.StructArray.from_arrays([pa.array(rng.random(count))] * len(Seconds._fields), Seconds._fields),
        "command": [f"levelproof generate size=s budget=128k first_level={i} levels=1" for i in ids],
    }
    columns = {
        name: own.get(name, table.column(name) if name in table.column_names else None) for name in COLUMNS.names
    }
    made = pa.table(
        {
            name: pa.chunked_array(column) if isinstance(column, pa.ChunkedArray) else column
            for name, column in columns.items()
        }
    )
    return made.cast(COLUMNS)


def hollow_shard(path: Path, trajectories: int) -> None:
    """Write the files of a sealed shard, of the right size but empty."""
    files = max(1, trajectories * TRAJECTORY // FILE_BYTES)
    for name in ("zarr.json", *(f"{array}/zarr.json" for array in ARRAYS)):
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_text("{}")
    for array in ARRAYS:
        for number in range(files):
            file = path / array / "c" / str(number) / "0" / "0"
            file.parent.mkdir(parents=True)
            with file.open("wb") as opened:
                opened.truncate(trajectories * TRAJECTORY // files // len(ARRAYS))
