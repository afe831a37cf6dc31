"""Bytes of a stored transition in each density, and trajectories/s written and read on one core.

All trajectories of a split go into one shard of each density. Writing `resume` and `witness` includes the check that
every bit is restored; reading them includes the engine's steps.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pyarrow.compute as pc

from benchmarks import oracle
from benchmarks.report import Report, Table
from levelproof.configs.schema import Density
from levelproof.experts.config import RECORD_STEPS
from levelproof.levelgen.level import SIZES
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.read.rows import COLUMNS, read_rows
from levelproof.pipeline.runtime import own_cores, prepare_jax
from levelproof.pipeline.store.formats import Encoding
from levelproof.pipeline.store.manifest import require_manifest
from levelproof.pipeline.store.named import open_shard
from levelproof.pipeline.store.shard import Shard, stored_bytes, write_shard

PUBLISHED = {"s": 80, "m": 111, "l": 306}  # bytes per transition of Kinetix's 1M splits
BATCH = 64  # random trajectories per read
FIELDS: Mapping[str, Sequence[str] | None] = {
    "every field": None,
    "positions": ("record/state/position", "record/state/rotation"),
    "actions": ("record/action", "record/done"),
}
SECONDS = 0.7  # minimum CPU time of a measurement
# Splits made for the benchmark: witnesses of experts alone are longer than those of a search
BUDGET, LEVELS = "256k", {"s": 512, "m": 256, "l": 128}
ALONE = ("procedure=published", "stop.rule=solved")


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "split", type=Path, nargs="*", help=f"splits (default: new ones by experts alone, {BUDGET} env steps each)"
    )


def run(args: argparse.Namespace) -> Report:
    with _splits(args.split) as splits:  # generated on all cores
        prepare_jax(own_cores()[0])
        results = [result for split in splits for result in measured(split)]
    head = (
        "size",
        "trajectories",
        "density",
        "bytes",
        "of full",
        "published",
        "written/s",
        *(f"{result}/s" for result in FIELDS),
    )
    return Report(
        title="Storage",
        results=results,
        tables=[Table(head, [row(result) for result in results])],
        notes=[
            "All trajectories of the splits, trivial levels included. *bytes* per transition, over all files of one "
            "shard; *published*: of the reference's 1M splits. *written/s* and the columns after it: trajectories per "
            "second of CPU time, written all at once, and read in random batches of "
            f"{BATCH} to arrays of {', '.join(FIELDS)}; files are in the page cache, and programs are already "
            "compiled. Key frames of `witness` every 32 steps. The load average was "
            f"{os.getloadavg()[1]:.1f}, this benchmark included; other load slows it down.",
        ],
    )


@contextmanager
def _splits(splits: Sequence[Path]) -> Iterator[Sequence[Path]]:
    if splits:
        yield splits
        return
    with tempfile.TemporaryDirectory() as out:
        for size, levels in LEVELS.items():
            arguments = ("generate", f"size={size}", f"levels={levels}", f"budget={BUDGET}", f"out={out}", *ALONE)
            oracle.log(f"levelproof {' '.join(arguments)}")
            command = [sys.executable, "-m", "levelproof", *arguments]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=dict(oracle.our_environment()))
        yield [Path(out) / BUDGET / size for size in SIZES]


def measured(split: Path) -> Iterator[dict[str, Any]]:
    """Measure each density on the trajectories of a split, trivial levels included."""
    rows = require_manifest(split, COLUMNS).table
    rows = rows.filter(pc.is_valid(rows["shard"]))  # pyright: ignore[reportAttributeAccessIssue]
    if not rows.num_rows:
        raise UserError(f"The split {split} has no trajectories to measure: give another one.")
    size, ids = rows["size"][0].as_py(), rows["level_id"].to_pylist()
    encoding = open_shard(split, rows["shard"][0].as_py(), size).encoding
    arrays, full = read_rows(split, rows), None
    for density in get_args(Density):
        oracle.log(f"{size}: {density}, {len(ids)} trajectories")
        with tempfile.TemporaryDirectory() as folder:
            measurements = _stored(Path(folder), ids, arrays, replace(encoding, density=density))
        full = full or measurements["bytes_per_transition"]
        about = {"size": size, "trajectories": len(ids), "density": density, "published": PUBLISHED.get(size)}
        yield about | measurements | {"of_full": measurements["bytes_per_transition"] / full}


def _stored(
    folder: Path, level_ids: Sequence[int], arrays: Mapping[str, np.ndarray], encoding: Encoding
) -> dict[str, Any]:
    """Write all trajectories as one shard; measure its bytes and rates."""
    paths = (folder / f"{i}.zarr" for i in count())
    written = per_second(lambda: write_shard(next(paths), level_ids, arrays, encoding), len(level_ids))
    shard, rng = Shard(folder / "0.zarr"), np.random.default_rng(0)
    batch = lambda: rng.choice(len(level_ids), BATCH).tolist()
    return {
        "bytes_per_transition": stored_bytes(shard.path) / len(level_ids) / RECORD_STEPS,
        "written_per_second": written,
        "read_per_second": {
            name: per_second(lambda fields=fields: shard.read(batch(), fields), BATCH)
            for name, fields in FIELDS.items()
        },
    }


def per_second(work: Callable[[], Any], trajectories: int) -> float:
    """Return trajectories per second of CPU time; `work` handles `trajectories` a call, the first is not timed."""
    work()
    start, times = time.process_time(), 0
    while (taken := time.process_time() - start) < SECONDS:
        work()
        times += 1
    return trajectories * times / taken


def row(result: Mapping[str, Any]) -> list[str]:
    return [
        result["size"],
        f"{result['trajectories']:,}",
        result["density"],
        f"{result['bytes_per_transition']:.1f}",
        f"{result['of_full']:.0%}",
        str(result["published"] or "-"),
        *(f"{rate:,.0f}" for rate in (result["written_per_second"], *result["read_per_second"].values())),
    ]
