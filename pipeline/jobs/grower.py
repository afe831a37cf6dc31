"""A worker that grows units from seed files: simulates every witness, checks it, and commits its record."""

import socket
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from levelproof.configs.schema import GrowConfig
from levelproof.experts.labels import Label
from levelproof.experts.ledger import lap
from levelproof.experts.steps import EnvSteps, Seconds
from levelproof.levelgen.level import size_of
from levelproof.pipeline.jobs.schedule import Order, Round, Summary, UnitOutcome, WorkUnit
from levelproof.pipeline.jobs.unit import failure
from levelproof.pipeline.read.rows import parts_of
from levelproof.pipeline.store.checkpoints import SourceUnseen
from levelproof.pipeline.store.contents import table_for
from levelproof.pipeline.store.formats import Encoding
from levelproof.pipeline.store.layout import SHARDS, new_attempt, unit_name
from levelproof.pipeline.store.locks import committing
from levelproof.pipeline.store.manifest import begin_fragment, read_manifest, with_places, write_fragment
from levelproof.pipeline.store.publish import committed_levels
from levelproof.pipeline.store.shard import write_shard
from levelproof.pipeline.urls import as_typed


class Grower:
    """The units that this process grows, one after another; executors use it like a `Worker`."""

    pool = None  # nothing is trained
    compiling = 0.0

    def __init__(self, job: GrowConfig, split: Path) -> None:
        self._job, self._split = job, split
        self.stopping = False  # set by the executor to make the worker leave after the current unit

    def work(self, order: Order, seconds: float, ended: Callable[[], bool] = lambda: False) -> Round:
        """Grow all ordered units, however long that takes, and ask for another."""
        outcomes = [self._grow(unit) for unit in order.units]
        return self.leave(outcomes) if self.stopping else Round(outcomes, {}, wants=1)

    def leave(self, outcomes: Sequence[UnitOutcome] = ()) -> Round:
        """Leave; every ordered unit has ended."""
        return Round(list(outcomes), {}, wants=0, leaves=True)

    def _grow(self, unit: WorkUnit) -> UnitOutcome:
        try:
            with lap() as took:
                made = grow_unit(self._job, self._split, unit)
        except Exception as error:
            return failure(self._split, unit, error)
        return UnitOutcome(unit, replace(made, seconds=Seconds(replay=took.seconds)))


def grow_unit(job: GrowConfig, split: Path, unit: WorkUnit) -> Summary:
    """Commit the rows and records of a unit.

    Leaves out levels whose states differ here from the seed file's checksum, or whose witness misses the goal.

    Raises:
        SourceUnseen: this process does not find the seed files of all levels.
        Failure: a seed file is damaged.
        OSError: a write failed; nothing is committed.
    """
    source, there = Path(job.level_files), committed_levels(split, unit.name) & {*unit.level_ids}
    if there:  # an attempt committed all that it could, and its worker died before it could say so
        labels = read_manifest(source, ["label"], level_ids=sorted(there)).table.column("label").to_pylist()
        return Summary(len(there), labels.count(Label.SOLVED), EnvSteps(), fragment=unit.name)
    table = read_manifest(source, level_ids=list(unit.level_ids)).table
    if lacking := {*unit.level_ids} - {*table.column("level_id").to_pylist()}:
        raise SourceUnseen(
            f"The worker on {socket.gethostname()} does not find level {min(lacking)} in the seed files at "
            f"{as_typed(source)}: put them into a folder that all machines of the cluster share."
        )
    played = np.flatnonzero(table.column("shard").is_valid())
    good, arrays = np.zeros(0, int), {}
    if len(played):
        parts, places = parts_of(source, table.take(played))
        simulated = parts[0][0].restore(parts, table_for(size_of(job.size)), places)
        good = np.flatnonzero(simulated.unlike < 0)
        arrays = {name: np.moveaxis(x[good], 0, -1) for name, x in simulated.arrays.items()}
    kept = np.setdiff1d(np.arange(table.num_rows), np.delete(played, good))
    rows, name = table.take(kept), ""
    if len(kept):
        ids = rows.column("level_id").to_pylist()
        name = unit_name(ids[0], ids[-1])  # not of the unit: a later command may grow its first and last level
        if not {*ids} <= committed_levels(split, name):
            _commit(job, split, name, rows, arrays)
    steps = pc.call_function("sum", [table.column("steps_to_goal")]).as_py() or 0
    solved = rows.column("label").to_pylist().count(Label.SOLVED)
    return Summary(rows.num_rows, solved, EnvSteps(replayed=steps), fragment=name)


def _commit(job: GrowConfig, split: Path, unit: str, rows: pa.Table, arrays: dict[str, np.ndarray]) -> None:
    """Write the shard, if any level has a record, then the fragment."""
    witnessed = rows.column("shard").is_valid().to_numpy()
    with committing(split) as folder:
        paths = new_attempt(folder, unit)
        begin_fragment(paths)
        name = f"{SHARDS}/{paths.shard.name}"
        if witnessed.any():
            ids = rows.column("level_id").to_numpy()[witnessed].tolist()
            write_shard(paths.shard, ids, arrays, Encoding(job.density, job.key_every, job.task))
        places = np.where(witnessed, np.cumsum(witnessed) - 1, -1).tolist()
        rows = with_places(
            rows,
            [name if place >= 0 else None for place in places],
            [place if place >= 0 else None for place in places],
        )
        write_fragment(paths, rows, job.hash, job.results, densities=[job.stored])
