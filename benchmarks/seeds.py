"""Seeds against splits on a disk: bytes per level, and transitions/s of first episodes read in random batches.

The same trajectories are read several ways: simulated from seeds, decoded from `full` shards that the seeds grew into,
by the reference's own reader from an export of these, and, for comparison, stepped without any reading by
`levelproof.Lanes`. Transitions of first episodes count, and none that repeats another.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow.parquet as pq

import levelproof
from benchmarks import oracle
from benchmarks.fresh import LANES, STEPS, in_lanes
from benchmarks.plotting import pyplot, save
from benchmarks.report import RESULTS, Report, Table
from benchmarks.storage import PUBLISHED
from levelproof.experts.config import RECORD_STEPS
from levelproof.levelgen.level import SIZES
from levelproof.pipeline.dataset.dataset import EPISODES_AT_ONCE
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.runtime import own_cores, prepare_jax
from levelproof.pipeline.store.seed.file import seed_files

BATCH = 64
TRAJECTORIES = 2048  # of the seeds that are read, the first ones
MANIFESTS = Path(__file__).parent.parent / "manifests"
SEEDS = [MANIFESTS / "256k" / size for size in SIZES]
OBSERVATION = "symbolic_flat"
RELEASED, PLOT = "released data", "seeds.svg"
PUBLISHED_SPLITS = (  # of Kinetix-Offline, by its card: budget, size, solved levels, bytes
    ("1M", "s", 5_980_000, 123e9),
    ("1M", "m", 3_450_000, 98e9),
    ("1M", "l", 1_050_000, 82e9),
    ("10M", "s", 637_000, 12e9),
    ("10M", "m", 422_000, 11e9),
)


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "seeds", type=Path, nargs="*", default=SEEDS, help="folders of seed files, of one size each (default: 3)"
    )
    parser.add_argument("--seconds", type=float, default=20.0, help="CPU seconds of each measurement (default: 20)")
    parser.add_argument("--without-reference", action="store_true", help="leave out the reference's reader")


def run(args: argparse.Namespace) -> Report:
    prepare_jax(own_cores()[0])
    found, versions = [], {}
    for seeds in args.seeds:
        sizes = stored(seeds)
        with tempfile.TemporaryDirectory() as folder:
            split, part = Path(folder, "full", sizes["budget"], sizes["size"]), Path(folder, "part.parquet")
            rates, versions = read(seeds, part, split, args.seconds, args.without_reference)
            found.append({**sizes, "per_trajectory": bytes_of(part, sizes["size"]), "rates": rates})
    kept = found[0]["per_trajectory"]
    return Report(
        title="Seeds",
        results=found,
        tables=[files_of(found), extrapolation(found), columns_of(found), densities_of(found), rates_of(found)],
        notes=[
            "Bytes per solved level are those of all files, so levels that are not solved are included. Seeds keep "
            "first episodes; the rest of a released record of 256 steps is further episodes of the same expert.",
            f"The first {TRAJECTORIES:,} trajectories of each folder, from the page cache, with programs compiled "
            "before. *Seeds* are simulated up to the first success, which the rest of a record repeats; "
            "*full* shards are decoded. *First episodes* come from "
            "`Dataset.episode_batches`; *records* from `Dataset.batches`, whole ones of 256 steps, of which the first "
            "episode counts here. The *reference* returns such records; every array is copied, and its own jitted "
            "symbolic observation is made of the states. *Lanes* plays random actions with observations, and reads "
            "nothing.",
            f"Bytes per trajectory: those of *{RELEASED}* are {RECORD_STEPS} times the bytes of a transition in its 1M "
            f"split of this size; those of `full`, `resume` and `witness` {RECORD_STEPS} times what storage.md "
            "measured on witnesses of experts alone, which are longer than those of a search; those of `seed` are of "
            f"the first {TRAJECTORIES:,} trajectories here, trivial ones included, and of the levels without one in "
            "between. All but `seed` keep whole records.",
            f"![Bytes per trajectory of {found[0]['size']} on a logarithmic axis: released data, and our densities]"
            f"({PLOT})",
        ],
        plots={PLOT: partial(draw, kept)},
        reference=versions,
    )


def files_of(found: Sequence[dict[str, Any]]) -> Table:
    """Tabulate what the files hold and how large they are."""
    head = ("size", "budget", "levels", "solved", "bytes", "per solved level, all others included")
    rows = [
        [one["size"], one["budget"], *(f"{one[name]:,}" for name in ("levels", "solved", "bytes")),
         f"{one['bytes'] / one['solved']:.1f}"]
        for one in found
    ]  # fmt: skip
    return Table(head, rows, "Files")


def columns_of(found: Sequence[dict[str, Any]]) -> Table:
    """Tabulate the bytes of each column, largest first."""
    names = sorted(found[0]["columns"], key=lambda name: -found[0]["columns"][name])
    head = ("column", *(f"{what} of {one['size']}" for one in found for what in ("bytes", "per solved level")))
    of = lambda one, name: one["columns"].get(name, 0)
    rows = [
        [name, *(text for one in found for text in (f"{of(one, name):,}", f"{of(one, name) / one['solved']:.2f}"))]
        for name in names
    ]
    return Table(head, rows, "Columns")


def densities_of(found: Sequence[dict[str, Any]]) -> Table:
    """Tabulate the bytes of a trajectory in every density."""
    sizes = [one["per_trajectory"] for one in found]
    share = lambda each, name: f"{each[name]:,.0f} ({each[name] / each[RELEASED]:.2%})"
    rows = [[name, *(share(each, name) for each in sizes)] for name in sizes[0]]
    return Table(("stored as", *(one["size"] for one in found)), rows, "Bytes per trajectory, and of released data's")


def rates_of(found: Sequence[dict[str, Any]]) -> Table:
    """Tabulate what each way to read reaches."""
    rows = []
    for one in found:
        top = one["rates"]["Lanes"]["transitions"]
        for name, rate in one["rates"].items():
            trajectories = f"{rate['trajectories']:,.0f}" if "trajectories" in rate else "-"
            rows.append([one["size"], name, f"{rate['transitions']:,.0f}", trajectories,
                         f"{rate['transitions'] / top:.3f}"])  # fmt: skip
    title = f"First episodes in random batches of {BATCH}, with {OBSERVATION} observations; per second of CPU time"
    return Table(("size", "read from", "transitions/s", "trajectories/s", "against Lanes"), rows, title)


def extrapolation(found: Sequence[Mapping[str, Any]]) -> Table:
    """Tabulate what the released dataset's splits would take at each size's bytes per solved level."""
    per_level = {one["size"]: one["bytes"] / one["solved"] for one in found}
    splits = [split for split in PUBLISHED_SPLITS if split[1] in per_level]
    rows = [
        [budget, size, f"{levels:,}", f"{bytes_ / 1e9:,.0f}", f"{per_level[size]:.1f}",
         f"{levels * per_level[size] / 1e6:,.0f}"]
        for budget, size, levels, bytes_ in splits
    ]  # fmt: skip
    levels, bytes_ = sum(split[2] for split in splits), sum(split[3] for split in splits)
    seeds = sum(levels * per_level[size] for _, size, levels, _ in splits)
    rows.append(["all", "", f"{levels:,}", f"{bytes_ / 1e9:,.0f}", f"{seeds / levels:.1f}", f"{seeds / 1e6:,.0f}"])
    head = ("budget", "size", "solved levels", "released, GB", "bytes per solved level here", "as seeds, MB")
    return Table(head, rows, "Splits of the released dataset, and what seeds of as many solved levels would take")


def stored(seeds: Path) -> dict[str, Any]:
    """Return bytes of all files and of each column, and the number of levels and of solved ones."""
    columns: dict[str, int] = {}
    total = levels = solved = 0
    for path in seed_files(seeds):
        file = pq.ParquetFile(path)
        total, levels = total + path.stat().st_size, levels + file.metadata.num_rows
        solved += file.read(["label"])["label"].to_pylist().count("solved")
        for group in range(file.metadata.num_row_groups):
            for number in range(file.metadata.num_columns):
                column = file.metadata.row_group(group).column(number)
                columns[column.path_in_schema] = columns.get(column.path_in_schema, 0) + column.total_compressed_size
    if not total:
        raise Failure(f"There are no seed files at {seeds}.")
    about = levelproof.read_manifest(seeds, ["size", "budget"]).table
    columns["(metadata)"] = total - sum(columns.values())
    facts = {"size": about["size"][0].as_py(), "budget": about["budget"][0].as_py()}
    return facts | {"bytes": total, "levels": levels, "solved": solved, "columns": columns}


def bytes_of(part: Path, size: str) -> dict[str, float]:
    """Return the bytes of a trajectory in the released data, in each density as generated, and in a seed file.

    Splits that grow from seeds would take less than generated ones: the later episodes of their records repeat the
    first.
    """
    witnesses = pq.read_table(part, columns=["witness"])["witness"]
    count = len(witnesses) - witnesses.null_count
    rows = [line.strip("| ").split(" | ") for line in (RESULTS / "storage.md").read_text().splitlines()]
    found = {f"`{row[2]}`": RECORD_STEPS * float(row[3]) for row in rows if row[0] == size and len(row) > 3}
    released = {RELEASED: RECORD_STEPS * PUBLISHED[size]} if size in PUBLISHED else {}
    return {**released, **found, "`seed`": part.stat().st_size / count}


def draw(kept: Mapping[str, float], path: Path) -> None:
    """Plot the bytes of a trajectory as bars on a logarithmic axis."""
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(6, 2.0), layout="constrained")
    names = [name.strip("`") for name in kept]
    axes.barh(names, [*kept.values()], color=["#777777", *["#0072b2"] * (len(kept) - 1)], height=0.6)
    for row, size in enumerate(kept.values()):
        axes.annotate(f"{size:,.0f}", (size, row), xytext=(3, 0), textcoords="offset points", va="center", fontsize=8)
    axes.set(xscale="log", xlim=(1, 3 * max(kept.values())), xlabel="bytes per trajectory")
    axes.invert_yaxis()
    save(figure, path)


def read(seeds: Path, part: Path, split: Path, seconds: float, alone: bool) -> tuple[dict[str, Any], dict[str, str]]:
    """Measure every way to get at the trajectories; return transitions and trajectories per second of CPU time.

    Args:
        seeds: the seed files.
        part: new seed file, of the trajectories that are read.
        split: new split, which `part` grows into.
        seconds: CPU seconds of each measurement.
        alone: leave out the reference's reader.
    """
    data = levelproof.open(seeds)
    first, last = (data.manifest["level_id"][i].as_py() for i in (0, min(TRAJECTORIES, len(data)) - 1))
    within = f"level_id BETWEEN {first} AND {last}"
    oracle.run_levelproof("export", seeds, "--format", "seed", "--where", within, "-o", part)
    oracle.run_levelproof("grow", part, "-o", split, "density=full", "executor=inline")
    ways = {"seeds": part, "full": split}
    rates = {f"{name}, first episodes": of_episodes(path, seconds) for name, path in ways.items()}
    rates |= {f"{name}, records": of_records(path, seconds) for name, path in ways.items()}
    versions: dict[str, str] = {}
    if not alone:
        python, kinetix = oracle.oracle_python(), split.with_name("kinetix")
        oracle.run_levelproof("export", split, "--format", "kinetix", "--where", "shard IS NOT NULL", "-o", kinetix)
        kept = split.with_name("kept")
        arguments = [kinetix, "--batch", BATCH, "--seconds", seconds, "--keep", kept]
        theirs = json.loads(oracle.run_script(python, "batches", arguments, "read trajectories with the reference"))
        arguments = [kept, "--size", split.name, "--seconds", seconds]
        observed = json.loads(oracle.run_script(python, "observed", arguments, "observe with the reference"))
        steps = float(np.mean(levelproof.open(split).manifest["steps_to_goal"].to_numpy()))
        read, seen = theirs["core_copied"], 1 / (1 / theirs["core_copied"] + observed["core"])
        rates |= {name: {"transitions": rate * steps, "trajectories": rate}
                  for name, rate in (("reference, not observed", read), ("reference", seen))}  # fmt: skip
        versions = oracle.versions(python)
    return rates | {"Lanes": {"transitions": of_lanes(split.name, seconds)}}, versions


def of_episodes(path: Path, seconds: float) -> dict[str, float]:
    """Read random batches of first episodes; return transitions and trajectories per second of CPU time."""
    batches = levelproof.open(path).episode_batches(BATCH, seed=0, observation=OBSERVATION, epochs=None)
    transitions, count, spent = repeated(lambda: len(next(batches).reward), seconds, EPISODES_AT_ONCE // BATCH)
    batches.close()
    return {"transitions": transitions / spent, "trajectories": count * BATCH / spent}


def of_records(path: Path, seconds: float) -> dict[str, float]:
    """Read random batches of records; return transitions of first episodes and trajectories per second of CPU time."""
    data = levelproof.open(path)
    ids, steps = (data.manifest[name].to_numpy() for name in ("level_id", "steps_to_goal"))
    batches = data.batches(BATCH, seed=0, observation=OBSERVATION, epochs=None)
    work = lambda: int(steps[np.searchsorted(ids, next(batches).level_id)].sum())
    transitions, count, spent = repeated(work, seconds, EPISODES_AT_ONCE // BATCH)
    batches.close()
    return {"transitions": transitions / spent, "trajectories": count * BATCH / spent}


def of_lanes(size: str, seconds: float) -> float:
    """Step lanes of a table with random actions and observations; return env steps per second of CPU time."""
    env, params = levelproof.make(levelproof.sample_levels(np.arange(TRAJECTORIES), size))
    episodes, play = in_lanes(env, params, LANES, TRAJECTORIES)
    keys = iter(jax.random.split(jax.random.key(0), 1_000_000))

    def turn() -> int:
        nonlocal episodes
        episodes, _ = jax.block_until_ready(play(episodes, next(keys)))
        return LANES * STEPS

    steps, _, spent = repeated(turn, seconds)
    return steps / spent


def repeated(work: Callable[[], int], seconds: float, together: int = 1) -> tuple[int, int, float]:
    """Repeat `work` for some CPU seconds; return its sum, the calls and the seconds.

    Calls come in groups of `together`, which share what they wait for. Two groups before the others compile.
    """
    for _ in range(2 * together):
        work()
    start, total, calls = time.process_time(), 0, 0
    while (spent := time.process_time() - start) < seconds:
        total, calls = total + sum(work() for _ in range(together)), calls + together
    return total, calls, spent
