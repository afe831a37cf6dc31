"""What speaks for some rows of a manifest: their ids or files, their shards, the replay of their witnesses, and proofs.

Worked out for many levels at once, whatever shards they lie in.
"""

import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Int

from levelproof.experts.labels import TRAINED, WITNESSED, Label
from levelproof.experts.verdict.before import decide
from levelproof.experts.witness.witness import Record, replay, steps_to_goal, succeeds
from levelproof.levelgen.batching import LANES
from levelproof.levelgen.identity.content import content_hashes, level_id_for
from levelproof.levelgen.identity.signature import signatures
from levelproof.levelgen.level import Level, size_of
from levelproof.levelgen.sampling.sampler import Distribution, sample_levels
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.read.level_files import level_at
from levelproof.pipeline.read.rows import COLUMNS as PLACED
from levelproof.pipeline.read.rows import read_placed
from levelproof.pipeline.store.fields import arrays_of, same_bits, tree_of, unlike_fields
from levelproof.pipeline.store.origins import RECORD, origin_of
from levelproof.pipeline.store.provenance import device, versions
from levelproof.pipeline.store.shard import EngineDiffers, Shard
from levelproof.pipeline.verify.findings import Findings

COLUMNS = (
    "label", "label_reason", "failed_by_noop", "content_hash", "signature", "file", "size", "steps_to_goal", "shard",
    "row", "experts", "budget",
    "versions", "device",
)  # fmt: skip

Mask = Bool[np.ndarray, " level"]
Lanes = Int[np.ndarray, " lane"]  # indices of some of the levels


@dataclass(frozen=True)
class Making:
    """What a split's levels are made and played by."""

    split: Path
    size: str
    distribution: Distribution | None  # None: no id makes a level, their shards or files have them
    rules: TaskParams


class Evidence:
    """What there is to ask about some rows. A level of which something is wrong is asked no more."""

    def __init__(self, rows: pa.Table, making: Making, shards: dict[str, Shard | None], findings: Findings) -> None:
        """Of rows with COLUMNS and level ids, and the shards that they name; None: one that is told to be unusable."""
        self.making, self.shards, self.findings = making, shards, findings
        self.ids: np.ndarray = rows.column("level_id").to_numpy()
        self.of: dict[str, list[Any]] = {name: rows.column(name).to_pylist() for name in COLUMNS if name != "versions"}
        self._placed = rows.select(PLACED)
        self.same_stack = same_stack(rows)
        self.told = np.zeros(len(self.ids), bool)

    def examine(self) -> None:
        sizes, shard, labels = self.of["size"], self.of["shard"], self.of["label"]
        self._tell(
            [size != self.making.size for size in sizes],
            lambda i: f"is of size {sizes[i]}, its split of {self.making.size}",
        )
        self._tell(
            [(label in WITNESSED) != (name is not None) for label, name in zip(labels, shard, strict=True)],
            lambda i: f"is {labels[i]}, and its shard is {shard[i]}",
        )
        stored = np.flatnonzero(self._claims())
        if self.making.distribution is None:
            levels = self._kept(stored)
        else:
            made = sample_levels(jnp.asarray(self.ids), size_of(self.making.size), self.making.distribution)
            levels = jax.tree.map(np.array, made)  # to be replaced by what shards hold
        known = self._identity(levels)
        for first in range(0, len(stored), LANES):
            known[self._witnesses(stored[first : first + LANES], levels)] = True
        self._labels(levels, known)
        self.findings.levels += len(self.ids)

    def _tell(self, where: Any, what: Callable[[int], str], lanes: Any = slice(None)) -> None:
        """Note what is wrong with these of the lanes' levels, those that have a sentence left out."""
        where, ids = np.asarray(where, bool), self.ids[lanes]
        new = np.flatnonzero(where & ~self.told[lanes])
        for i in new:
            self.findings.tell(f"Level {ids[i]} {what(int(i))}.", [int(ids[i])])
        self.told[lanes] |= where

    def _claims(self) -> Mask:
        """Which levels have a row of a shard: one whose id stands there."""
        names, rows = self.of["shard"], self.of["row"]
        holds: list[int | None] = []
        for name, row in zip(names, rows, strict=True):
            shard = self.shards.get(name)
            ids = shard.level_ids if shard else []
            holds.append(ids[row] if row is not None and 0 <= row < len(ids) else None)
        self.told |= [name is not None and self.shards[name] is None for name in names]  # with their shards
        right = np.array(holds, object) == self.ids
        wrong = ~right & [name is not None for name in names]
        self._tell(wrong, lambda i: f"is said to be row {rows[i]} of {names[i]}, which has level {holds[i]} there")
        return right

    def _kept(self, stored: Lanes) -> Level:
        """Levels that no id makes, from their shards and, without one, from their files."""
        levels = jax.tree.map(np.array, empty_level(size_of(self.making.size), len(self.ids)))
        ours = arrays_of(levels, "level/")

        def put(lanes: Lanes, arrays: dict[str, np.ndarray]) -> None:
            for name in ours if len(lanes) else ():
                ours[name][..., lanes] = arrays[name]

        for first in range(0, len(stored), LANES):
            put(*self._read(stored[first : first + LANES], ours))
        for i in np.flatnonzero([shard is None for shard in self.of["shard"]]):
            row, lane = {name: values[i] for name, values in self.of.items()}, np.array([i])
            try:
                put(lane, arrays_of(level_at(origin_of(self.making.split, row)), "level/"))
            except Failure as failure:
                reason = str(failure)[:-1]
                self._tell([True], lambda _, reason=reason: f"cannot be made again: {reason}", lane)
        return levels

    def _identity(self, made: Level) -> Mask:
        """Whether rows are of the very levels that their ids make; on another stack, levels have to look like those."""
        rows = list(zip(self.of["content_hash"], self.of["signature"], strict=True))
        ours = list(zip(content_hashes(made), signatures(made), strict=True))
        same = np.array([a == b for a, b in zip(rows, ours, strict=True)])
        if self.making.distribution is None:
            own = [level_id_for(of) == level_id for (of, _), level_id in zip(ours, self.ids, strict=True)]
            same &= np.array(own) | [RECORD.fullmatch(file or "") is not None for file in self.of["file"]]
        near = np.array([bool(set(a[1]) & set(b[1])) for a, b in zip(rows, ours, strict=True)])
        self._tell(
            ~np.where(self.same_stack, same, near),
            lambda _: (
                "has not the content hash and the signature of the level that its id makes"
                if self.making.distribution
                else "has not the id, the content hash and the signature of the level in its shard or file"
            ),
        )
        return same

    def _witnesses(self, lanes: Lanes, levels: Level) -> Lanes:
        """Look at what shards hold of these levels, and put their worlds in place of those in `levels`.

        Returns:
            The levels of which worlds were found that their rows speak of.
        """
        lanes, arrays = self._read(lanes)
        if not len(lanes):
            return lanes
        level, record = tree_of(Level, arrays, "level/"), tree_of(Record, arrays, "record/")
        self._worlds(lanes, level, levels)
        again = replay(level, record.action, self.making.rules)
        done = np.asarray(again.done)
        differs, steps = unlike_fields(record, again), steps_to_goal(done)
        labels, claimed = (np.array(self.of[name], object)[lanes] for name in ("label", "steps_to_goal"))
        self.findings.witnesses += len(lanes)
        unlike, other = np.isin(np.arange(len(lanes)), list(differs)), self._restored_otherwise(lanes)
        self.findings.same_bits += int((~unlike & ~other).sum())
        tell = partial(self._tell, lanes=lanes)
        tell(unlike & self.same_stack[lanes], lambda i: f"has a witness that does not replay: its {differs[i]} differs")
        tell(other & self.same_stack[lanes], lambda _: "has other states than its shard's checksums and key frames say")
        tell(~succeeds(done, again.goal), lambda _: "has a witness that does not reach the goal when replayed")
        busy = record.action.any((0, 1))
        tell(busy & (labels == Label.TRIVIAL), lambda _: "is trivial, and its witness does something")
        late = (claimed != steps) & ~unlike
        tell(late, lambda i: f"reaches the goal in {steps[i]} steps, the manifest says {claimed[i]}")
        return lanes

    def _read(self, lanes: Lanes, fields: Iterable[str] | None = None) -> tuple[Lanes, dict[str, np.ndarray]]:
        """The levels that could be read, and what their shards hold of them: all at once, or one by one if need be."""
        if not len(lanes):
            return lanes, {}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", EngineDiffers)  # is told level by level
            try:
                return lanes, self._stored(lanes, fields)
            except Failure:
                found = {i: arrays for i in lanes.tolist() if (arrays := self._alone(i, fields))}
        return np.array([*found], int), jax.tree.map(lambda *xs: np.concatenate(xs, -1), *found.values() or ({},))

    def _stored(self, lanes: Lanes, fields: Iterable[str] | None) -> dict[str, np.ndarray]:
        """Raises Failure where a shard is damaged."""
        opened: dict[str, Any] = self.shards  # levels of one that is unusable have no claim to it
        arrays = read_placed(self.making.split, self._placed.take(lanes), fields, lambda _, name, __: opened[name])
        return {name: np.moveaxis(x, 0, -1) for name, x in arrays.items()}

    def _alone(self, i: int, fields: Iterable[str] | None) -> dict[str, np.ndarray] | None:
        """Of one level; None: it is damaged, which is told."""
        try:
            return self._stored(np.array([i]), fields)
        except Failure as failure:
            self.findings.unlike.add(self.of["shard"][i])
            self.findings.tell(str(failure), [int(self.ids[i])])
            self.told[i] = True
        return None

    def _restored_otherwise(self, lanes: Lanes) -> Mask:
        """Of which levels this machine computes other states than those that were not stored."""
        wrong = np.zeros(len(lanes), bool)
        names = np.array(self.of["shard"], object)[lanes]
        for name in dict.fromkeys(names):
            shard = self.shards[name]
            if shard and shard.encoding.density != "full":
                wrong[names == name] = shard.unlike([self.of["row"][i] for i in lanes[names == name]]) >= 0
        return wrong

    def _worlds(self, lanes: Lanes, stored: Level, levels: Level) -> None:
        """Compare the worlds in shards with those that ids make, and put them in their place."""
        ours = arrays_of(levels)
        same = np.array([same_bits(x, ours[name][..., lanes]) for name, x in arrays_of(stored).items()]).all(0)
        wrong = ~same & self.same_stack[lanes]
        self._tell(wrong, lambda _: "has another world in its shard than its id makes", lanes)
        if not same.all():
            hashes = content_hashes(stored)
            other = [self.of["content_hash"][i] != of for i, of in zip(lanes, hashes, strict=True)]
            self._tell(other, lambda _: "has another world in its shard than its content hash says", lanes)
        for name, values in arrays_of(stored).items():
            ours[name][..., lanes] = values

    def _labels(self, levels: Level, known: Mask) -> None:
        """Labels that need no expert, worked out again for the levels of which every bit is known."""
        verdicts, failed = decide(levels, self.making.rules)
        labels, reasons = self.of["label"], self.of["label_reason"]
        rows = list(zip(verdicts, labels, reasons, strict=True))
        wrong = np.array([label != v.label if v else label not in TRAINED for v, label, _ in rows])
        self._tell(
            known & wrong,
            lambda i: (
                f"is {labels[i]}, and {f'it should be {v.label}' if (v := verdicts[i]) else 'nothing proves that'}"
            ),
        )
        unlike = np.array([v is not None and reason != v.label_reason for v, _, reason in rows])
        self._tell(known & unlike & self.same_stack, lambda i: f"is {labels[i]} for another reason than its row has")
        self._tell(
            known & (failed != np.array(self.of["failed_by_noop"])),
            lambda i: f"{'fails' if failed[i] else 'does not fail'} by doing nothing, the manifest says otherwise",
        )


def same_stack(rows: pa.Table) -> Mask:
    """Whether bits are promised: a row was made with these versions on such a device."""
    made_with = rows.column("versions").combine_chunks()
    same = [made_with.field(name).to_numpy(zero_copy_only=False) == value for name, value in versions().items()]
    return np.logical_and.reduce([*same, rows.column("device").to_numpy() == device()])
