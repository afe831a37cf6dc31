"""A seed file as a shard: records are simulated when they are read. Each repeats its first episode."""

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Int

from levelproof.experts.witness.episode import play_episodes, repeated_rows
from levelproof.levelgen.level import Level, name_of
from levelproof.levelgen.task.observe.kinds import ObservationType
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.density import Restored
from levelproof.pipeline.store.fields import arrays_of
from levelproof.pipeline.store.formats import Encoding, FieldSpec
from levelproof.pipeline.store.mapped import find_table, share_table, whole
from levelproof.pipeline.store.seed.file import (
    damaged_seed,
    describe_seed,
    find_levels,
    name_of_table,
    read_seed,
    seed_files,
)
from levelproof.pipeline.store.seed.packed import unpack_witnesses
from levelproof.pipeline.store.seed.source import LevelSource
from levelproof.pipeline.store.shard import Part, Shard

COLUMNS = ("label", "steps_to_goal", "witness", "checksum")
RECORD = "record/"


class SeedEpisodes(NamedTuple):
    """First episodes of levels, whose env steps are the rows of arrays, one episode after another."""

    level: dict[str, np.ndarray]  # fields of levels, [level, ...]
    steps: Int[np.ndarray, " level"]
    rows: dict[str, np.ndarray]  # fields of records, [row, ...]
    observation: Any  # of the state before each action, [row, ...]; None if not requested
    wrong: Bool[np.ndarray, " level"]  # whether this machine's engine plays another episode than the stored one


class SeedShard(Shard):
    """One seed file. Its rows take some twenty bytes each; processes share those of a large file (`store.mapped`).

    Attributes:
        path: path or URL of the file.
        size: size of its levels.
        encoding: the task's rules, and the engine's version that its records are from.
        level_ids: ids of all rows, int32 [row].
    """

    def __init__(self, path: Path, size: str | None = None) -> None:
        """Read the seed file at `path`, whose levels must have `size`, if given.

        Raises:
            Failure: it is missing, damaged or of another size, or this program makes other levels from its ids.
        """
        self.path = path
        config = describe_seed(path).fragment.config
        self._source = LevelSource.of(config, path)
        self.size = self._source.size
        if size not in (None, name_of(self.size)):
            raise Failure(f"The levels of {path} have size {name_of(self.size)}, but {size} was expected.")
        engine = config["engine_version"]
        self.encoding = Encoding("witness", rules=self._source.rules, engine_version=engine)
        rows = self._shared("rows", self._read)
        self.level_ids: Any = whole(rows.column("level_id")).to_numpy()
        self.steps: np.ndarray = whole(rows.column("steps_to_goal")).to_numpy()
        self.checksum: np.ndarray = whole(rows.column("checksum")).to_numpy()
        self.witness: pa.ChunkedArray = rows.column("witness")

    def _read(self) -> pa.Table:
        rows = read_seed(self.path, COLUMNS, compact=True)[1].drop_columns("label")  # it is only checked
        for name in ("steps_to_goal", "checksum"):
            rows = rows.set_column(rows.schema.get_field_index(name), name, rows.column(name).fill_null(0))
        return rows.replace_schema_metadata(None)

    def _shared(self, what: str, read: Callable[[], pa.Table]) -> pa.Table:
        """Return a table of this file that another process has shared, or read it and share it."""
        name = name_of_table(what, [self.path])
        if name is None:
            return read()
        found = find_table(name)
        return share_table(name, read()) if found is None else found

    @cached_property
    def _content(self) -> pa.ChunkedArray:
        read = lambda: read_seed(self.path, ["content"])[1].select(["content"]).replace_schema_metadata(None)
        return self._shared("content", read).column("content")

    def levels(self, rows: Sequence[int]) -> Level:
        """Make the levels of these rows: numpy arrays, level axis last.

        Raises:
            UserError: the file was written without its levels.
            Failure: their content is invalid.
        """
        sampled = self._source.distribution is not None
        content = [] if sampled else self._content.take(pa.array(rows, pa.int64())).to_pylist()
        return self._source.levels(self.level_ids[np.asarray(rows)], content)

    def actions(self, rows: Sequence[int]) -> np.ndarray:
        """Unpack the actions of the first episodes of these rows, [256, 6, level]; zeros after their ends.

        Raises:
            Failure: they are invalid, or a row has none.
        """
        packed = self.witness.take(pa.array(rows, pa.int64())).to_pylist()
        try:
            if None in packed:
                raise ValueError("it has no witness for a level that should have one")
            return unpack_witnesses(packed, self.steps[np.asarray(rows)])
        except ValueError as error:
            raise damaged_seed(self.path, error) from error

    def restore(self, parts: Sequence[Part], table: Sequence[FieldSpec], places: Sequence[Sequence[int]]) -> Restored:
        """Simulate rows of seed files. Raises as `Shard.restore`."""
        seeds: Any = parts
        names = [field.name for field in table]
        if not any(name.startswith(RECORD) for name in names):
            level = _levels(seeds, _order(places))
            return Restored(_of_levels(level, names), np.full(len(level), -1))
        made = play_seeds(seeds, places, names)
        rows = repeated_rows(made.steps)
        arrays = made.level | {name: x.take(rows, 0) for name, x in made.rows.items()}
        return Restored({name: arrays[name] for name in names}, np.where(made.wrong, 0, -1))


SeedPart = tuple[SeedShard, Sequence[int]]


def stored_levels(source: Path, level_ids: np.ndarray) -> Level:
    """Unpack levels, in the order of their ids, from the content that seed files have of them.

    Raises:
        Failure: a file is damaged or missing.
    """
    contents: dict[int, bytes | None] = {}
    config = None
    for path in seed_files(source):
        about, at = find_levels(path, level_ids)
        config, rows = about.fragment.config, read_seed(path, ["content"], at=at)[1]
        contents |= dict(zip(rows.column("level_id").to_pylist(), rows.column("content").to_pylist(), strict=True))
    return LevelSource.of(config or {}, source).levels(level_ids, [contents.get(i) for i in level_ids.tolist()])


def play_seeds(
    parts: Sequence[SeedPart],
    places: Sequence[Sequence[int]],
    names: Sequence[str],
    observation: ObservationType | None = None,
) -> SeedEpisodes:
    """Simulate the first episodes of rows of seed files of one size and one set of rules.

    Args:
        parts: seed files, and rows of each.
        places: positions of each part's rows in the result.
        names: fields of the shard to return.
        observation: type of the observation to return; None: none.

    Raises:
        Failure: a row is invalid.
    """
    order = _order(places)
    level = _levels(parts, order)
    steps, checksum = (
        _joined([getattr(shard, name)[np.asarray(rows)] for shard, rows in parts], order)
        for name in ("steps", "checksum")
    )
    action = _joined([shard.actions(rows) for shard, rows in parts], order)
    wanted = frozenset(name.removeprefix(RECORD) for name in names if name.startswith(RECORD))
    made = play_episodes(level, action, steps, parts[0][0].encoding.rules, wanted, observation)
    rows = {f"{RECORD}{name}": x for name, x in made.fields.items()}
    is_last = np.zeros(steps.sum(), bool)
    is_last[np.cumsum(steps) - 1] = True
    # As stored: if this machine's states differ, an episode may reach its goal at another step, or not at all
    rows |= {name: is_last for name in (f"{RECORD}done", f"{RECORD}goal") if name in rows}
    wrong = ~made.reaches | (made.checksum != checksum)
    return SeedEpisodes(_of_levels(level, names), steps, rows, made.observation, wrong)


def _levels(parts: Sequence[SeedPart], order: np.ndarray | None) -> Level:
    """Make the levels of rows, level axis last."""
    return jax.tree.map(lambda *xs: _joined(xs, order), *[shard.levels(rows) for shard, rows in parts])


def _order(places: Sequence[Sequence[int]]) -> np.ndarray | None:
    """Return which row of the joined parts stands at each position of the result; None: they are in order."""
    order = np.argsort(np.concatenate([np.asarray(mine, int) for mine in places]))
    return None if (order[1:] > order[:-1]).all() else order


def _joined(arrays: Sequence[np.ndarray], order: np.ndarray | None) -> np.ndarray:
    """Join arrays of several parts along their last axis; copy no more than that takes, because they are large."""
    joined = np.concatenate(arrays, -1) if len(arrays) > 1 else arrays[0]
    return joined if order is None else joined[..., order]


def _of_levels(level: Level, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the named arrays of levels, level axis first."""
    return {name: np.moveaxis(x, -1, 0) for name, x in arrays_of(level, "level/").items() if name in names}
