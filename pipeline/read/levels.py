"""One level that a user names, by its id in a split or by a level file, and the file that is made of it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa

from levelproof.configs.convert import typed
from levelproof.configs.schema import from_files
from levelproof.levelgen.files.level_file import LevelFile, LevelFileError, read_level_file
from levelproof.levelgen.level import Level, size_of
from levelproof.levelgen.sampling.sampler import Distribution, sample_levels
from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.read.level_files import levels_at
from levelproof.pipeline.read.rows import read_rows
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.contents import level_fields
from levelproof.pipeline.store.fields import tree_of
from levelproof.pipeline.store.manifest import Manifest, require_manifest
from levelproof.pipeline.store.origins import ASKED, origin_of
from levelproof.pipeline.words import many

COLUMNS = ("label", "label_reason", *ASKED)  # of a level that is drawn or exported


def find_level(split: Path, level_id: int) -> tuple[Manifest, dict[str, Any]]:
    """The manifest's row of a level, with as little as has to be read for it: COLUMNS, and the level's id.

    Raises:
        UserError: there is no split, or it has no such level.
        Failure: a fragment is damaged.
    """
    manifest = require_manifest(split, COLUMNS, [level_id])
    if not manifest.table.num_rows:
        ids = require_manifest(split, []).level_ids
        raise UserError(
            f"There is no level {level_id} in {split}: it has {many(len(ids), 'level')}, from {ids[0]} to {ids[-1]}."
        )
    return manifest, manifest.table.to_pylist()[0]


def levels_of(manifest: Manifest, rows: pa.Table) -> Level:
    """The levels of these rows, with COLUMNS, in their order: numpy arrays, level axis last.

    As their shards have them, or made again from their ids or files where they have no shard.

    Raises:
        Failure: a shard is damaged, or a file is gone or another one; or as `recorded_settings`.
    """
    stored = rows.column("shard").is_valid().to_numpy()
    size = size_of(rows.column("size")[0].as_py())
    parts = []
    if stored.any():
        names = [field.name for field in level_fields(size)]
        parts.append(tree_of(Level, read_rows(manifest.split, rows.filter(stored), names), "level/"))
    if not stored.all():
        prepare_jax()
        others, distribution = rows.filter(~stored), distribution_of(manifest)
        if distribution is None:
            parts.append(levels_at([origin_of(manifest.split, row) for row in others.to_pylist()]))
        else:
            parts.append(sample_levels(others.column("level_id").to_numpy(), size, distribution))
    back = np.argsort(np.concatenate([np.flatnonzero(stored), np.flatnonzero(~stored)]))
    return jax.tree.map(lambda *lanes: np.concatenate(lanes, -1)[..., back], *parts)


def distribution_of(manifest: Manifest) -> Distribution | None:
    """What a split's levels are sampled from; None: they come from files. Raises as `recorded_settings`."""
    config = manifest.config or {}
    with recorded_settings(manifest.split):
        return None if from_files(config) else typed(Distribution, config["distribution"], "distribution")


def rules_of(manifest: Manifest) -> TaskParams:
    """The rules that a split's levels are played by. Raises as `recorded_settings`."""
    with recorded_settings(manifest.split):
        return typed(TaskParams, (manifest.config or {})["task"], "task")


@contextmanager
def recorded_settings(split: Path) -> Iterator[None]:
    """Settings that a split records are understood meanwhile.

    Raises:
        Failure: this program has other ones.
    """
    try:
        yield
    except (ValueError, KeyError, TypeError) as error:
        raise Failure(
            f"The split {split} was made by a levelproof with other settings ({error}): use that one."
        ) from None


@contextmanager
def writing_to(out: Path) -> Iterator[None]:
    """A file that a user named is written meanwhile, in a folder that is made where it is not there.

    Raises:
        UserError: it cannot be written.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise UserError(f"Cannot write {out} ({error.strerror or error}): choose another file with -o.") from None


def is_level_file(source: Path) -> bool:
    """Whether a user who writes this means a level file, not a split."""
    return source.is_file() or (source.suffix.lower() == ".json" and not source.is_dir())


def level_file(path: Path) -> LevelFile:
    """What a level file says.

    Raises:
        UserError: it cannot be used.
    """
    try:
        return read_level_file(path)
    except LevelFileError as error:
        raise UserError(str(error)) from None
