"""Checks of manifest rows against evidence: ids or files, shards, replayed witnesses, and proofs.

Checks many levels at once, across shards.
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
from levelproof.levelgen.identity.content import VERSION, content_hashes, level_id_for
from levelproof.levelgen.identity.signature import signatures
from levelproof.levelgen.level import Level, size_of
from levelproof.levelgen.sampling.sampler import CHUNK, Distribution, sample_levels
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.task.rules import TaskParams
from levelproof.physics.step import ENGINE_VERSION
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.read.level_files import level_at
from levelproof.pipeline.read.rows import COLUMNS as POSITION_COLUMNS
from levelproof.pipeline.read.rows import gather_rows
from levelproof.pipeline.store.bounds import unread
from levelproof.pipeline.store.fields import arrays_of, same_bits, tree_of, unlike_fields
from levelproof.pipeline.store.origins import RECORD, origin_of
from levelproof.pipeline.store.provenance import device, versions
from levelproof.pipeline.store.seed.file import is_seed
from levelproof.pipeline.store.seed.shard import stored_levels
from levelproof.pipeline.store.shard import EngineDiffers, Shard
from levelproof.pipeline.verify.findings import Findings

COLUMNS = (
    "label", "label_reason", "failed_by_noop", "content_hash", "signature", "file", "size", "steps_to_goal", "shard",
    "row", "experts", "budget",
    "versions", "engine", "device",
)  # fmt: skip

PREFIX = f"c{VERSION}:"  # of content hashes as they are computed today
Mask = Bool[np.ndarray, " level"]
Lanes = Int[np.ndarray, " lane"]  # indices of some of the levels


@dataclass(frozen=True)
class Recipe:
    """What determines the levels of a split and how they are played."""

    split: Path
    size: str
    distribution: Distribution | None  # None: levels come from shards or files, not from ids
    rules: TaskParams


def examine_rows(rows: pa.Table, recipe: Recipe, shards: dict[str, Shard | None], findings: Findings) -> None:
    """Run all checks of rows, as many at once as the sampler's program takes. Arguments as of `Evidence`."""
    for first in range(0, rows.num_rows, CHUNK):
        Evidence(rows.slice(first, CHUNK), recipe, shards, findings).examine()


class Evidence:
    """Checks of some rows, in order; after its first problem a level is not checked further."""

    def __init__(self, rows: pa.Table, recipe: Recipe, shards: dict[str, Shard | None], findings: Findings) -> None:
        """Prepare the checks.

        Args:
            rows: manifest rows with `level_id` and COLUMNS.
            recipe: how the split's levels are made and played.
            shards: shards that the rows name; None: unusable, already in `findings`.
            findings: receives the problems.
        """
        self.recipe, self.shards, self.findings = recipe, shards, findings
        self.ids: np.ndarray = rows.column("level_id").to_numpy()
        self.columns: dict[str, list[Any]] = {
            name: rows.column(name).to_pylist() for name in COLUMNS if name != "versions"
        }
        self._positions = rows.select(POSITION_COLUMNS)
        self.portable = portable(rows)
        self.same_release = self.portable & _made_with(rows, "levelproof", versions()["levelproof"])
        self.reported = np.zeros(len(self.ids), bool)

    def examine(self) -> None:
        """Run all checks."""
        sizes, shard, labels = self.columns["size"], self.columns["shard"], self.columns["label"]
        self._report(
            [size != self.recipe.size for size in sizes],
            lambda i: f"has size {sizes[i]}, but its split has {self.recipe.size}",
        )
        self._report(
            [(label in WITNESSED) != (name is not None) for label, name in zip(labels, shard, strict=True)],
            lambda i: f"is {labels[i]}, but its shard is {shard[i]}",
        )
        stored = np.flatnonzero(self._check_positions())
        if self.recipe.distribution is None:
            levels = self._load_levels(stored)
        else:
            sampled = sample_levels(jnp.asarray(self.ids), size_of(self.recipe.size), self.recipe.distribution)
            levels = jax.tree.map(np.array, sampled)  # writable: worlds in shards replace them
        known = self._check_identities(levels)
        for first in range(0, len(stored), LANES):
            known[self._check_witnesses(stored[first : first + LANES], levels)] = True
        self._check_labels(levels, known)
        self.findings.levels += len(self.ids)

    def _report(self, wrong: Any, describe: Callable[[int], str], lanes: Any = slice(None)) -> None:
        """Report the wrong ones among the levels at `lanes`, except those already reported.

        Args:
            wrong: flag per lane.
            describe: returns the sentence about a lane, without its subject.
            lanes: indices of the levels; default: all.
        """
        wrong, ids = np.asarray(wrong, bool), self.ids[lanes]
        new = np.flatnonzero(wrong & ~self.reported[lanes])
        for i in new:
            self.findings.add(f"Level {ids[i]} {describe(int(i))}.", [int(ids[i])])
        self.reported[lanes] |= wrong

    def _check_positions(self) -> Mask:
        """Check positions; return which levels are in a shard at the row that the manifest names."""
        names, rows = self.columns["shard"], self.columns["row"]
        holds: list[int | None] = []
        for name, row in zip(names, rows, strict=True):
            shard = self.shards.get(name)
            ids = shard.level_ids if shard else []
            holds.append(int(ids[row]) if row is not None and 0 <= row < len(ids) else None)
        # Levels of unusable shards were reported when these were opened
        self.reported |= [name is not None and self.shards[name] is None for name in names]
        right = np.array(holds, object) == self.ids
        wrong = ~right & [name is not None for name in names]
        self._report(wrong, lambda i: f"should be in row {rows[i]} of {names[i]}, which has level {holds[i]} there")
        return right

    def _load_levels(self, stored: Lanes) -> Level:
        """Load levels that do not come from ids: from seeds or shards, or from their files if they are in none."""
        levels = jax.tree.map(np.array, empty_level(size_of(self.recipe.size), len(self.ids)))
        ours = arrays_of(levels, "level/")

        def put(lanes: Lanes, arrays: dict[str, np.ndarray]) -> None:
            for name in ours if len(lanes) else ():
                ours[name][..., lanes] = arrays[name]

        for first in range(0, len(stored), LANES):
            put(*self._read(stored[first : first + LANES], ours))
        others = np.flatnonzero([shard is None for shard in self.columns["shard"]])
        if len(others) and is_seed(self.recipe.split):
            put(others, arrays_of(stored_levels(self.recipe.split, self.ids[others]), "level/"))
            return levels
        for i in others:
            row, lane = {name: values[i] for name, values in self.columns.items()}, np.array([i])
            row["level_id"] = int(self.ids[i])
            try:
                put(lane, arrays_of(level_at(origin_of(self.recipe.split, row)), "level/"))
            except Failure as failure:
                reason = str(failure)[:-1]
                self._report([True], lambda _, reason=reason: f"cannot be rebuilt: {reason}", lane)
        return levels

    def _check_identities(self, levels: Level) -> Mask:
        """Check that rows describe the levels that their ids make; return which ones match in every bit.

        A row made by another engine, or not on a CPU, needs only a matching signature; but a world that is
        stored, not made from its id, has the same content hash everywhere.
        """
        rows = list(zip(self.columns["content_hash"], self.columns["signature"], strict=True))
        ours = list(zip(content_hashes(levels), signatures(levels), strict=True))
        same = np.array([a == b for a, b in zip(rows, ours, strict=True)])
        near = np.array([bool(set(a[1]) & set(b[1])) for a, b in zip(rows, ours, strict=True)])
        if self.recipe.distribution is None:
            own = [level_id_for(content) == level_id for (content, _), level_id in zip(ours, self.ids, strict=True)]
            own = np.array(own) | [RECORD.fullmatch(file or "") is not None for file in self.columns["file"]]
            other = np.array([a.startswith(PREFIX) and a != b for (a, _), (b, _) in zip(rows, ours, strict=True)])
            same &= own
            near &= (own & ~other) | [shard is None for shard in self.columns["shard"]]
        self._report(
            ~np.where(self.portable, same, near),
            lambda _: (
                "has a content hash or a signature that differs from the level that its id makes"
                if self.recipe.distribution
                else "has an id, a content hash or a signature that differs from the level in its shard or file"
            ),
        )
        return same

    def _check_witnesses(self, lanes: Lanes, levels: Level) -> Lanes:
        """Check the stored worlds and records of these levels; copy the stored worlds into `levels`.

        Returns:
            The lanes that could be read.
        """
        lanes, arrays = self._read(lanes)
        if not len(lanes):
            return lanes
        level, record = tree_of(Level, arrays, "level/"), tree_of(Record, arrays, "record/")
        self._check_worlds(lanes, level, levels)
        replayed = replay(level, record.action, self.recipe.rules)
        done = np.asarray(replayed.done)
        differs, steps = unlike_fields(record, replayed), steps_to_goal(done)
        labels, claimed = (np.array(self.columns[name], object)[lanes] for name in ("label", "steps_to_goal"))
        self.findings.witnesses += len(lanes)
        unlike, restored_differently = np.isin(np.arange(len(lanes)), list(differs)), self._restores_differently(lanes)
        self.findings.same_bits += int((~unlike & ~restored_differently).sum())
        report = partial(self._report, lanes=lanes)
        report(unlike & self.portable[lanes], lambda i: f"has a witness that does not replay: its {differs[i]} differs")
        report(
            restored_differently & self.portable[lanes],
            lambda _: "has states that differ from its shard's checksums or key frames",
        )
        report(~succeeds(done, replayed.goal), lambda _: "has a witness that does not reach the goal when replayed")
        busy = record.action.any((0, 1))
        report(busy & (labels == Label.TRIVIAL), lambda _: "is trivial, but its witness does something")
        late = (claimed != steps) & ~unlike
        report(late, lambda i: f"reaches the goal in {steps[i]} steps, but the manifest says {claimed[i]}")
        return lanes

    def _read(self, lanes: Lanes, fields: Iterable[str] | None = None) -> tuple[Lanes, dict[str, np.ndarray]]:
        """Read arrays of levels from their shards, one by one if a shard is damaged; return the lanes that it read."""
        if not len(lanes):
            return lanes, {}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", EngineDiffers)  # reported level by level
            try:
                return lanes, self._read_stored(lanes, fields)
            except Failure:
                readable = {i: arrays for i in lanes.tolist() if (arrays := self._read_one(i, fields))}
        return np.array([*readable], int), jax.tree.map(lambda *xs: np.concatenate(xs, -1), *readable.values() or ({},))

    def _read_stored(self, lanes: Lanes, fields: Iterable[str] | None) -> dict[str, np.ndarray]:
        """Read arrays of levels, level axis last. Raise Failure if a shard is damaged."""
        opened: dict[str, Any] = self.shards  # never None here: `_check_positions` excludes levels of unusable shards
        arrays = gather_rows(self.recipe.split, self._positions.take(lanes), fields, lambda _, name, __: opened[name])
        return {name: np.moveaxis(x, 0, -1) for name, x in arrays.items()}

    def _read_one(self, i: int, fields: Iterable[str] | None) -> dict[str, np.ndarray] | None:
        """Read arrays of one level; report it and return None if it is damaged.

        Raises:
            DataUnread: the shard's bytes are those that were committed, but this machine cannot read them now.
        """
        try:
            return self._read_stored(np.array([i]), fields)
        except Failure as failure:
            name = self.columns["shard"][i]
            if name not in self.findings.changed and (machines := unread(self.recipe.split / name, failure.__cause__)):
                raise machines from None
            self.findings.changed.add(name)
            self.findings.add(str(failure), [int(self.ids[i])])
            self.reported[i] = True
        return None

    def _restores_differently(self, lanes: Lanes) -> Mask:
        """Return which levels' unstored states this machine recomputes with different bits."""
        wrong = np.zeros(len(lanes), bool)
        names = np.array(self.columns["shard"], object)[lanes]
        for name in dict.fromkeys(names):
            shard = self.shards[name]
            if shard and shard.encoding.density != "full":
                wrong[names == name] = shard.unlike([self.columns["row"][i] for i in lanes[names == name]]) >= 0
        return wrong

    def _check_worlds(self, lanes: Lanes, stored: Level, levels: Level) -> None:
        """Check stored worlds against those in `levels`, which ids made, and replace them."""
        ours = arrays_of(levels)
        same = np.array([same_bits(x, ours[name][..., lanes]) for name, x in arrays_of(stored).items()]).all(0)
        wrong = ~same & self.portable[lanes]
        self._report(wrong, lambda _: "has a world in its shard that differs from the one its id makes", lanes)
        if not (same & self.portable[lanes]).all():  # rows whose hashes `_check_identities` may not have compared
            hashes = content_hashes(stored)
            other = [self.columns["content_hash"][i] != content for i, content in zip(lanes, hashes, strict=True)]
            self._report(other, lambda _: "has a world in its shard that differs from its content hash", lanes)
        for name, values in arrays_of(stored).items():
            ours[name][..., lanes] = values

    def _check_labels(self, levels: Level, known: Mask) -> None:
        """Check labels that need no expert, for levels whose every bit is `known`.

        For other engines or GPUs, checks only unsolvable labels: doing nothing may end differently there.
        """
        verdicts, failed = decide(levels, self.recipe.rules)
        labels, reasons = self.columns["label"], self.columns["label_reason"]
        # A replayed witness overrules a proof that there is none
        beaten = [
            v and v.label == Label.UNSOLVABLE and label in WITNESSED for v, label in zip(verdicts, labels, strict=True)
        ]
        verdicts = [None if wins else v for v, wins in zip(verdicts, beaten, strict=True)]
        rows = list(zip(verdicts, labels, reasons, strict=True))
        wrong = np.array([label != v.label if v else label not in TRAINED for v, label, _ in rows])
        proved = np.array([v is not None and v.label == Label.UNSOLVABLE for v in verdicts])
        proof_differs = proved != (np.array(labels, object) == Label.UNSOLVABLE)
        self._report(
            known & wrong & (self.portable | proof_differs),
            lambda i: f"is {labels[i]}, but {f'should be {v.label}' if (v := verdicts[i]) else 'nothing proves that'}",
        )
        unlike = np.array([v is not None and reason != v.label_reason for v, _, reason in rows])
        self._report(known & unlike & self.same_release, lambda i: f"is {labels[i]}, but not for the reason in its row")
        self._report(
            known & self.portable & (failed != np.array(self.columns["failed_by_noop"])),
            lambda i: f"{'fails' if failed[i] else 'does not fail'} by doing nothing, but the manifest says otherwise",
        )


def portable(rows: pa.Table) -> Mask:
    """Return which rows' worlds and records this machine must reproduce bit for bit.

    They are those that this engine made on a CPU, if this machine also computes on one, of any kind; and those of the
    same stack.
    """
    on_cpu = np.array([name.startswith("cpu:") for name in rows.column("device").to_pylist()], bool)
    return same_stack(rows) | (_same_engine(rows) & on_cpu & device().startswith("cpu:"))


def same_stack(rows: pa.Table) -> Mask:
    """Return which rows were made with the same versions and device as here, so that training repeats bit for bit."""
    same = [_made_with(rows, name, value) for name, value in versions().items()]
    return np.logical_and.reduce([*same, _same_engine(rows), rows.column("device").to_numpy() == device()])


def _made_with(rows: pa.Table, name: str, version: Any) -> Mask:
    return rows.column("versions").combine_chunks().field(name).to_numpy(zero_copy_only=False) == version


def _same_engine(rows: pa.Table) -> Mask:
    return rows.column("engine").to_numpy() == ENGINE_VERSION
