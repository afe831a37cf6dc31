"""Attempts of the levels' own experts, from a split's rows or the sealed levels' file, to compare with a policy."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Bool, Int

from levelproof.configs.schema import from_files
from levelproof.experts.labels import Label
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import name_of
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.learn.measured import MeasuredLevels
from levelproof.pipeline.learn.sealed import known_sealed
from levelproof.pipeline.learn.solve_rates import Solved
from levelproof.pipeline.read.levels import COLUMNS, levels_of
from levelproof.pipeline.read.select import labelled
from levelproof.pipeline.store.manifest import require_manifest
from levelproof.pipeline.store.seed.file import is_seed

ATTEMPTS = 16  # attempts per expert in splits whose configuration does not say
COMPARED = 64  # levels that are compared with the split's
ROUNDED = 0.05  # share of them that may differ: a choice may flip where a GPU rounded otherwise


class Specialists(NamedTuple):
    """The experts of a split."""

    name: str  # as shown to users
    solved: Solved  # first episodes with sampled actions; without a rate: all solved if the level is trivial, else none


def specialists_of(split: Path, levels: MeasuredLevels, attempts: int) -> Specialists | None:
    """Return the rated attempts of the experts of these levels, at most `attempts` of each.

    A level without a rate counts as solved in every attempt if it is trivial, else in none. The order of a level's
    attempts is drawn, because a row has only their share.

    Returns:
        None if the split's levels are of another size.

    Raises:
        UserError: there is no such split, it lacks a level or has another one of its id, or no solved one of them
            has a rate.
        Failure: the split is damaged.
    """
    level_ids = levels.level_ids
    manifest = require_manifest(split, ["label", "success_rate", "budget"], level_ids)
    config = manifest.config or require_manifest(split, []).config or {}  # no fragment was read: none has such ids
    if config.get("size") != name_of(levels.levels.size):
        return None
    missing = np.setdiff1d(level_ids, manifest.level_ids)
    if len(missing):
        raise UserError(
            f"{split} lacks {len(missing):,} of the levels, such as {missing[0]}: label them there first, or name "
            "another split with --experts."
        )
    _require_same_levels(split, levels, config)
    rows = manifest.table.take(np.searchsorted(manifest.level_ids, level_ids))
    rates = rows.filter(pc.field("label") == Label.SOLVED)["success_rate"]
    if len(rates) and rates.null_count == len(rates):
        raise UserError(
            f"{split} has no success rates, because procedure=label does not measure them: name a split made with "
            "another procedure with --experts."
        )
    own = config.get("expert", {}).get("attempts", ATTEMPTS)
    solved = _drawn(successes_of(rows, own), own, attempts)
    return Specialists(_named(rows["budget"][0].as_py(), solved, attempts), solved)


def _require_same_levels(split: Path, levels: MeasuredLevels, config: Mapping[str, Any]) -> None:
    """Raise UserError if a split has other levels of these ids: of another distribution, or imported ones."""
    some = np.argsort(levels.level_ids)[:COMPARED]
    ids, ours = levels.level_ids[some], take(levels.levels, some)
    try:
        manifest = require_manifest(split, ["level_id", *COLUMNS], ids)
        theirs = levels_of(manifest, manifest.table.sort_by("level_id"))
    except UserError:
        if is_seed(split) and from_files(config):
            return  # written without its levels, which alone could tell
        raise
    near = [_near(x, y) for x, y in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True)]
    others = ids[~np.logical_and.reduce(near)]
    if len(others) > ROUNDED * len(ids):
        raise UserError(
            f"{split} has other levels with the ids of {levels.name}, such as {others[0]}: name a split of the same "
            "levels with --experts."
        )


def _near(one: np.ndarray, other: np.ndarray) -> Bool[np.ndarray, " lane"]:
    """Return which lanes are equal up to rounding."""
    equal = np.isclose(one, other, 1e-3, 1e-3) if np.asarray(one).dtype.kind == "f" else np.equal(one, other)
    return np.all(equal, axis=tuple(range(one.ndim - 1)))


def sealed_specialists(size: str, count: int, attempts: int) -> list[Specialists]:
    """Return the rated attempts of the experts of the first `count` sealed levels, for each budget that is known.

    Their order is drawn as that of `specialists_of`.
    """
    known = known_sealed(size)
    successes = known.successes if known else {}
    solved = {name: _drawn(each[:count], ATTEMPTS, attempts) for name, each in successes.items()}
    return [Specialists(_named(name, each, attempts), each) for name, each in solved.items()]


def successes_of(rows: pa.Table, attempts: int) -> Int[np.ndarray, " level"]:
    """Return in how many of its `attempts` each row's expert reached the goal: all if the level is trivial."""
    rates = rows["success_rate"].fill_null(0.0).to_numpy()
    rates = np.where(labelled(rows, [Label.TRIVIAL]), 1.0, rates)
    return np.round(rates * attempts).astype(np.int64)


def _named(budget: str, solved: Solved, attempts: int) -> str:
    """Name a row; if it has fewer attempts than its table, say how many."""
    own = solved.shape[1]
    return f"its own expert, {budget}{f', {own} attempts' if own < attempts else ''}"


def _drawn(successes: Int[np.ndarray, " level"], own: int, attempts: int) -> Solved:
    solved = np.arange(own) < successes[:, None]
    return np.random.default_rng(0).permuted(solved, axis=1)[:, :attempts]
