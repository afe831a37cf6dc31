"""How long commands take to start on a sealed split of millions of levels, and how much memory they need.

The split is made for this: rows of the committed reference manifest, drawn anew, with ids, hashes, signatures and
commands of their own; shards with as many files as sealed ones have, of their size and without any content.
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
from levelproof.pipeline.store.columns import COLUMNS
from levelproof.pipeline.store.layout import new_attempt, split_path, unit_name
from levelproof.pipeline.store.manifest import begin_fragment, write_fragment
from levelproof.pipeline.store.merge import FILE_BYTES
from levelproof.pipeline.store.seal import ROWS

REFERENCE = Path(__file__).parent.parent / "manifests" / "128k-s.parquet"
SECONDS, BYTES = 10, 2 * 2**30  # that each command should stay within
ENTRIES, FILES = 10_000, 20_000  # of a folder, and in all
TRAJECTORY = 12_500  # bytes of one, of size s
ALIKE = 200  # one in so many levels looks like the next
MORE = 2**17  # levels that `generate` is to add
ARRAYS = ("dyn32", "dyn8", "act", "lvl32", "lvl8")
CONDITION = "label = 'solved' AND steps_to_goal < 64"
OPEN = f"import levelproof, sys; print(len(levelproof.open(sys.argv[1], where={CONDITION!r})))"


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--levels", default="6M", help="of the split (default: 6M)")
    parser.add_argument("--repeats", type=int, default=1, help="of each command; the slowest counts (default: 1)")
    parser.add_argument("--split", type=Path, help="keep the split in this folder, or use the one that is there")


def run(given: argparse.Namespace) -> Report:
    levels = parse_count(given.levels, "levels")
    folder = given.split or Path(tempfile.mkdtemp(prefix="levelproof-"))
    try:
        split = split_path(str(folder), "128k", "s")
        if not split.exists():
            made_split(folder, levels)
        results = [measured(name, words, given.repeats) for name, words in commands(folder, split, levels).items()]
        files = [Path(at) / name for at, _, names in os.walk(split) for name in names]
        entries = max(Counter(path.parent for path in [*files, *split.rglob("*/")]).values())
    finally:
        if not given.split:
            shutil.rmtree(folder)
    worst = [of["name"] for of in results if of["seconds"] > SECONDS or of["bytes"] > BYTES]
    head = ("command", "seconds", "core-seconds", "peak memory, MiB")
    numbers = lambda of: (f"{of['seconds']:.1f}", f"{of['core_seconds']:.1f}", f"{of['bytes'] / 2**20:,.0f}")
    return Report(
        title="Manifests of millions of levels",
        results=[*results, {"name": "layout", "files": len(files), "largest_folder": entries}],
        tables=[Table(head, [(of["name"], *numbers(of)) for of in results])],
        notes=[
            f"Whole processes on a sealed split of {levels:,} levels with {MORE:,} more to come, the files in the "
            f"system's cache. It has {len(files):,} files, and its largest folder {entries:,} entries. The aim is "
            f"{SECONDS} s and {BYTES / 2**20:,.0f} MiB for each, {FILES:,} files, and {ENTRIES:,} entries.",
        ],
        fault=f"{', '.join(worst)}: more than {SECONDS} s or {BYTES / 2**20:,.0f} MiB." if worst else "",
    )


def commands(folder: Path, split: Path, levels: int) -> dict[str, Sequence[str]]:
    return {
        "levelproof status": ("-m", "levelproof", "status", str(split)),
        "levelproof inspect": ("-m", "levelproof", "inspect", str(split)),
        f'levelproof inspect --where "{CONDITION}"': ("-m", "levelproof", "inspect", str(split), "--where", CONDITION),
        "levelproof generate, until the first unit": (
            "-m", "benchmarks.ours.start", f"out={folder}", "size=s", "budget=128k", f"levels={levels + MORE}",
        ),
        f'levelproof.open(where="{CONDITION}")': ("-c", OPEN, str(split)),
    }  # fmt: skip


def measured(name: str, words: Sequence[str], repeats: int) -> dict[str, Any]:
    """Wall seconds, core-seconds and peak memory of a process, the worst of some."""
    seconds, cores, most = [], [], []
    for _ in range(repeats):
        start = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, *words], env=dict(oracle.our_environment()), stdout=subprocess.DEVNULL
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        seconds.append(time.perf_counter() - start)
        cores.append(usage.ru_utime + usage.ru_stime)
        most.append(usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024))
        if process.returncode:
            raise RuntimeError(f"{name} failed")
    return {"name": name, "seconds": max(seconds), "core_seconds": max(cores), "bytes": max(most)}


def made_split(folder: Path, levels: int) -> None:
    """A sealed split of so many levels."""
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
    """A row for each id: what came of a level is drawn from `base`, what is a level's own is new."""
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
        {name: pa.chunked_array(of) if isinstance(of, pa.ChunkedArray) else of for name, of in columns.items()}
    )
    return made.cast(COLUMNS)


def hollow_shard(path: Path, trajectories: int) -> None:
    """The files of a sealed shard, of their size, without content."""
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
