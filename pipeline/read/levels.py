"""Levels of a split by id, and level files that users name."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from levelproof.configs.schema import distribution_in, other_sampler, rules_in
from levelproof.levelgen.files.entries import LevelFileError
from levelproof.levelgen.files.level_file import LevelFile, read_level_file
from levelproof.levelgen.identity.keys import MAX_LEVEL_ID
from levelproof.levelgen.level import Level, concatenate_levels, size_of
from levelproof.levelgen.sampling.sampler import Distribution, on_cpu, sample_levels
from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.read.level_files import levels_at
from levelproof.pipeline.read.rows import read_rows
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.contents import level_fields
from levelproof.pipeline.store.fields import tree_of
from levelproof.pipeline.store.manifest import Manifest, require_manifest
from levelproof.pipeline.store.origins import ASKED, origin_of
from levelproof.pipeline.store.seed.file import is_seed
from levelproof.pipeline.store.seed.rows import COSTS
from levelproof.pipeline.store.seed.shard import stored_levels
from levelproof.pipeline.words import many

COLUMNS = ("label", "label_reason", "device", *ASKED)  # read for a level that is drawn or exported


def find_level(split: Path, level_id: int) -> tuple[Manifest, dict[str, Any]]:
    """Read the manifest row of a level (COLUMNS and `level_id`), opening as few fragments as possible.

    Returns:
        The manifest with this row alone, and the row.

    Raises:
        UserError: the split or the level does not exist.
        Failure: a fragment is damaged.
    """
    manifest = require_manifest(split, COLUMNS, [level_id] if 0 <= level_id <= MAX_LEVEL_ID else [])
    if not manifest.table.num_rows:
        ids = require_manifest(split, []).level_ids
        raise UserError(
            f"There is no level {level_id} in {split}: it has {many(len(ids), 'level')}, from {ids[0]} to {ids[-1]}."
        )
    return manifest, manifest.table.to_pylist()[0]


def with_known_costs(manifest: Manifest) -> pa.Table:
    """Return the manifest's rows, with null for costs that seeds left out: they are read as 0."""
    rows = manifest.table
    for name in COSTS if manifest.repeats else ():
        if (at := rows.schema.get_field_index(name)) >= 0:
            rows = rows.set_column(at, rows.field(at).with_nullable(True), pa.nulls(rows.num_rows, rows.field(at).type))
    return rows


def levels_of(manifest: Manifest, rows: pa.Table, in_command: bool = True) -> Level:
    """Return the levels of these rows (with COLUMNS), in row order: numpy arrays, level axis last.

    Reads levels from their shards; regenerates those without a shard from their ids or files. In a command, sets JAX
    up before that; in a program of the user's, JAX keeps the user's settings.

    Raises:
        Failure: a shard is damaged, a file is missing or has changed, another sampler made levels that no shard holds,
            or as `recorded_settings`.
    """
    stored = rows.column("shard").is_valid().to_numpy()
    size = size_of(rows.column("size")[0].as_py())
    parts = []
    if stored.any():
        names = [field.name for field in level_fields(size)]
        parts.append(tree_of(Level, read_rows(manifest.split, rows.filter(stored), names), "level/"))
    if not stored.all():
        if in_command:
            prepare_jax()
        others, distribution = rows.filter(~stored), distribution_of(manifest)
        if differs := other_sampler(manifest.config or {}):
            raise Failure(f"The split {manifest.split} {differs}: use the levelproof that made it.")
        if distribution is None and is_seed(manifest.split):
            parts.append(stored_levels(manifest.split, others.column("level_id").to_numpy()))
        elif distribution is None:
            parts.append(levels_at([origin_of(manifest.split, row) for row in others.to_pylist()]))
        else:
            devices = others["device"].unique().to_pylist() if "device" in others.column_names else []
            with on_cpu() if all(device.startswith("cpu") for device in devices) else nullcontext():
                parts.append(sample_levels(others["level_id"].to_numpy(), size, distribution))
    order = np.argsort(np.concatenate([np.flatnonzero(stored), np.flatnonzero(~stored)]))
    return concatenate_levels(parts)[order]


def distribution_of(manifest: Manifest) -> Distribution | None:
    """Return the distribution of a split's levels; None: they come from files. Raises as `recorded_settings`."""
    with recorded_settings(manifest.split):
        return distribution_in(manifest.config or {})


def rules_of(manifest: Manifest) -> TaskParams:
    """Return the task rules of a split. Raises as `recorded_settings`."""
    with recorded_settings(manifest.split):
        return rules_in(manifest.config or {})


@contextmanager
def recorded_settings(split: Path) -> Iterator[None]:
    """Report settings that the `with` block cannot parse as those of another version.

    Raises:
        Failure: the block raised ValueError, KeyError or TypeError.
    """
    try:
        yield
    except (ValueError, KeyError, TypeError) as error:
        raise Failure(
            f"This levelproof does not accept the settings of {split} ({error}): use the version that made it."
        ) from None


def is_level_file(source: Path) -> bool:
    """Whether a user who types this path means a level file, not a split or a seed file."""
    return (source.is_file() and not is_seed(source)) or (source.suffix.lower() == ".json" and not source.is_dir())


def level_file(path: Path, level_id: int | None = None) -> LevelFile:
    """Read a level file; `level_id` is an id that the user gave with it.

    Raises:
        UserError: the file is unreadable or invalid, or there is an id.
    """
    if level_id is not None:
        raise UserError(f"{path} is a level file, which has one level: leave out the id {level_id}.")
    try:
        return read_level_file(path)
    except LevelFileError as error:
        raise UserError(str(error)) from None
