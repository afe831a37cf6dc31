"""The levels in memory that updates draw from: a pure function of the splits, the settings and the update's number.

So a run that was killed continues with the same batches, without a position to keep.
"""

from collections.abc import Callable, Generator, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from dataclasses import replace
from threading import Event
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from levelproof.configs.clone import CloneConfig
from levelproof.experts.imitation import Transitions
from levelproof.experts.networks.over_levels import NetworkConfig
from levelproof.levelgen.level import Level, concatenate_levels
from levelproof.pipeline.dataset.dataset import Dataset
from levelproof.pipeline.dataset.order import EpochOrder
from levelproof.pipeline.learn.mirrored import Witnesses, mirrored
from levelproof.pipeline.runtime import own_cores

AT_ONCE = 64  # levels of a read
MOTION_FIELDS = tuple(f"record/state/{name}" for name in ("position", "velocity", "rotation", "angular_velocity"))
CONTACTS = "record/state/contact_active"
VALIDATED = 1024  # largest number of levels of a split that are validated on
DRAWN = 8  # transitions of each of them


class LevelPool(NamedTuple):
    """Levels, and the steps of their episodes one after another."""

    level: Level  # level axis last; `state` is None
    first: Int[np.ndarray, " level"]  # row of each level's first step
    steps: Int[np.ndarray, " level"]
    motion: Float[np.ndarray, "row column"]
    action: Int[np.ndarray, "row 6"]

    def draw(self, rng: np.random.Generator, levels: Int[np.ndarray, " lane"]) -> Transitions:
        """Draw a step of each of these levels, all steps equally likely."""
        row = self.first[levels] + (rng.random(len(levels)) * self.steps[levels]).astype(np.int64)
        level = jax.tree.map(lambda x: x[..., levels], self.level)
        return Transitions(level, self.motion[row], self.action[row].astype(np.int32))


class PartedSplit(NamedTuple):
    """The levels of one split that are trained on, and those that are validated on."""

    data: Dataset
    train: Int[np.ndarray, " level"]
    validation: Int[np.ndarray, " level"]
    copies: int  # levels in neither, because they have the content of sealed levels


def read_pool(
    data: Dataset,
    indices: Int[np.ndarray, " level"],
    network: NetworkConfig,
    whole: bool = False,
    mirror: bool = False,
    follow: Callable[[int], None] = lambda _: None,
) -> LevelPool:
    """Read levels into memory, with what moves in their records.

    Args:
        data: the split.
        indices: of the levels' trajectories.
        network: decides whether contacts are read.
        whole: read whole records, not only up to each one's first goal.
        mirror: add the mirror images that solve their mirrored level.
        follow: called with the number of levels of each read.
    """
    names = (*MOTION_FIELDS, *([CONTACTS] if network.reads_contacts else []))

    def read(some: Int[np.ndarray, " level"]) -> LevelPool:
        batch = data.read(some, fields=["level", *names], observation=None)
        fields = [batch.fields[name] for name in names]
        pool = _cut(Witnesses(batch.level, fields, batch.done, batch.action), whole)
        return _joined([pool, _cut(mirrored(batch, names, whole, data.rules), whole)]) if mirror else pool

    with ThreadPoolExecutor(len(own_cores())) as threads:
        parts, some = [], [indices[i : i + AT_ONCE] for i in range(0, len(indices), AT_ONCE)]
        try:
            for mine, part in zip(some, threads.map(read, some), strict=True):
                parts.append(part)
                follow(len(mine))
        except BaseException:  # Ctrl-C does not wait for the others
            threads.shutdown(wait=False, cancel_futures=True)
            raise
    return _joined(parts)


def _joined(parts: Sequence[LevelPool]) -> LevelPool:
    steps = np.concatenate([part.steps for part in parts])
    level = concatenate_levels([part.level for part in parts])
    motion, action = (np.concatenate([getattr(part, name) for part in parts]) for name in ("motion", "action"))
    return LevelPool(level, np.cumsum(steps) - steps, steps, motion, action)


def _cut(witnesses: Witnesses, whole: bool) -> LevelPool:
    """Keep the steps to train on, and only the moving fields of their states."""
    done, moving = witnesses.done, len(MOTION_FIELDS)
    motion, contacts = witnesses.fields[:moving], witnesses.fields[moving:]
    count, length = done.shape
    ends = np.where(done.any(1), done.argmax(1) + 1, length)
    steps = np.full(count, length) if whole else ends
    kept = np.arange(length) < steps[:, None]
    columns = [x if x.ndim == 4 else x[..., None] for x in motion]
    rows = np.concatenate(columns, -1)
    rows = rows.reshape(count, length, rows.shape[-2] * rows.shape[-1])  # of no witnesses, too
    rows = np.concatenate([rows, *contacts], -1, dtype=np.float32)[kept]
    level = jax.tree.map(lambda x: np.moveaxis(x, 0, -1), replace(witnesses.level, state=None))  # pyright: ignore
    return LevelPool(level, np.cumsum(steps) - steps, steps, rows, witnesses.action[kept].astype(np.int8))


class Feed:
    """The batches of all updates, read and drawn ahead by threads."""

    def __init__(self, sources: Sequence[PartedSplit], config: CloneConfig) -> None:
        self._sources, self._config = sources, config
        counts = np.array([len(source.train) for source in sources])
        self._weights = counts / counts.sum()
        total = int(counts.sum())
        rounds = -(-total // config.pool)  # of an epoch, as equal as can be: its last one repeats few levels
        self._orders = [EpochOrder(count, -(-count // rounds), config.seed) for count in counts.tolist()]

    @property
    def levels(self) -> int:
        """Number of levels that `read` reads."""
        return sum(order.batch_size for order in self._orders)

    @property
    def used(self) -> int:
        """Number of levels that some update draws from."""
        turns = self._turn(self._config.train.updates - 1) + 1
        return sum(min(turns * order.batch_size, order.count) for order in self._orders)

    def read(self, update: int, follow: Callable[[int], None] = lambda _: None) -> list[LevelPool]:
        """Read the pools that an update draws from, one for each split; call `follow` as `read_pool` does."""
        return self._read(self._turn(update), follow)

    def batches(self, first: int, pools: list[LevelPool]) -> Generator[Transitions, None, None]:
        """Yield the batches of all updates from number `first` on, which draws from `pools`."""
        config, over = self._config, Event()

        def follow(_: int) -> None:
            """Called after each read: end the reading ahead once no update needs its pool."""
            if over.is_set():
                raise CancelledError

        with ThreadPoolExecutor(1) as reader, ThreadPoolExecutor(1) as drawer:
            turn = self._turn(first)
            coming = self._ahead(reader, turn, follow)
            ahead = drawer.submit(self._draw, pools, first)
            try:
                for update in range(first, config.train.updates):
                    now = ahead.result()
                    if (after := self._turn(update + 1)) != turn and coming and update + 1 < config.train.updates:
                        turn, pools = after, coming.result()
                        coming = self._ahead(reader, turn, follow)
                    ahead = drawer.submit(self._draw, pools, update + 1)
                    yield now
            finally:
                over.set()

    def _ahead(
        self, reader: ThreadPoolExecutor, turn: int, follow: Callable[[int], None]
    ) -> Future[list[LevelPool]] | None:
        """Start to read the pools of the next turn; None: no update needs them."""
        needed = self._changes and (turn + 1) * self._config.refresh < self._config.train.updates
        return reader.submit(self._read, turn + 1, follow) if needed else None

    @property
    def _changes(self) -> bool:
        return any(order.batch_size < order.count for order in self._orders)

    def _turn(self, update: int) -> int:
        return update // self._config.refresh if self._changes else 0

    def _read(self, turn: int, follow: Callable[[int], None] = lambda _: None) -> list[LevelPool]:
        pools, network = [], self._config.network
        for source, order in zip(self._sources, self._orders, strict=True):
            items, _ = order.items(turn)  # an epoch's last round is padded with levels of its first
            whole, mirror = self._config.episodes == "all", self._config.mirror
            pools.append(read_pool(source.data, source.train[items], network, whole, mirror, follow))
        return pools

    def _draw(self, pools: Sequence[LevelPool], update: int) -> Transitions:
        """Draw an update's batch: of one split, because levels of one shape go through a program together."""
        rng = np.random.default_rng([self._config.seed, update])
        pool = pools[rng.choice(len(pools), p=self._weights)]
        return pool.draw(rng, rng.integers(0, len(pool.steps), self._config.train.batch))


def validation_batches(source: PartedSplit, config: CloneConfig) -> list[Transitions]:
    """Return whole batches of transitions of a split's validation levels, equal in runs of equal seed."""
    rng = np.random.default_rng(config.seed)
    chosen = rng.permutation(source.validation)[:VALIDATED]
    pool = read_pool(source.data, chosen, config.network, config.episodes == "all")
    levels = np.tile(np.arange(len(chosen)), DRAWN)
    batch = config.train.batch
    padded = np.resize(levels, -(-len(levels) // batch) * batch)
    return [pool.draw(rng, padded[i : i + batch]) for i in range(0, len(padded), batch)]
