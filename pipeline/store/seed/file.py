"""Seed files on a disk or behind a URL: recognising their paths, and reading them within bounds."""

import json
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.labels import WITNESSED, Label, Source
from levelproof.levelgen.identity.keys import MAX_LEVEL_ID
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.store.bounds import DAMAGE, Bounded, OtherKind, bounded
from levelproof.pipeline.store.formats import CONFIG_KEY, HASH_KEY
from levelproof.pipeline.store.fragment import Fragment, settings_in
from levelproof.pipeline.store.layout import MANIFEST
from levelproof.pipeline.store.remote import mended
from levelproof.pipeline.store.seed.columns import (
    BUDGET_KEY,
    CONTENT_KEY,
    ROW_GROUP,
    SEED_KEY,
    SEED_VERSION,
    SEEDS,
)
from levelproof.pipeline.store.seed.packed import MAX_BYTES
from levelproof.pipeline.urls import is_remote

SUFFIX = ".parquet"
STORED = "density=seed"
OPENED = "name a split, or what `levelproof export SPLIT --format seed` has written"
BUDGET = r"[A-Za-z0-9._]{1,32}"


@dataclass(frozen=True)
class SeedFile:
    """Metadata of a seed file."""

    fragment: Fragment
    budget: str  # as typed
    content: tuple[str, ...]  # SHA-256 of the content hashes of each row group


def is_seed(path: Path) -> bool:
    """Whether a path names a seed file or a folder of them, not a split with shards."""
    return bool(seed_files(path))


def seed_files(path: Path) -> list[Path]:
    """List the seed files at a path, by name; none if it is neither a seed file nor a folder of them."""
    if is_remote(path) or not path.is_dir():
        return [path] if path.suffix == SUFFIX and (is_remote(path) or path.is_file()) else []
    if (path / MANIFEST).exists():
        return []
    return sorted(file for file in path.glob(f"[!.]*{SUFFIX}") if file.is_file())


def file_of(source: Path, name: str) -> Path:
    """Return the seed file that a row of `source` names as its shard."""
    return source if source.suffix == SUFFIX and not source.is_dir() else source / name


def name_of_table(what: str, files: Sequence[Path]) -> str | None:
    """Name a table of seed files for `store.mapped`; None: a file is remote or missing."""
    states = [written(path) for path in files]
    return None if None in states else f"{what} of {[*zip(map(str, map(Path.absolute, files)), states, strict=True)]}"


def describe_seed(path: Path) -> SeedFile:
    """Read what a seed file says of itself. Raises as `read_seed`."""
    with _opened(path) as (about, _):
        return about


def written(path: Path) -> tuple[int, ...] | None:
    """Return a stamp that changes when a seed file is rewritten; None for a URL or a missing file."""
    try:
        about = path.stat()
    except OSError:
        return None
    return about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns


def read_seed(
    path: Path, names: Sequence[str], compact: bool = False, at: np.ndarray | None = None
) -> tuple[SeedFile, pa.Table]:
    """Read columns of a seed file, of all rows or, with `at` (from `find_levels`), at least of those positions.

    Raises:
        UserError: it is not a seed file.
        Failure: it is missing, damaged, or has another version.
    """
    with _opened(path) as (about, file):
        table = file.read(list(dict.fromkeys(["level_id", *names])), compact=compact, at=at)
        _check(table)
        return about, table


def find_levels(path: Path, level_ids: np.ndarray) -> tuple[SeedFile, np.ndarray]:
    """Return what a seed file says of itself, and the positions of its rows of these levels (ascending).

    A process reads a local file for this once, because it may ask for a few levels at a time. Raises as `read_seed`.
    """
    state = written(path)
    about, ids = _read_ids(path) if state is None else _known_ids(path, state)
    possible = level_ids[(level_ids >= 0) & (level_ids <= MAX_LEVEL_ID)].astype(ids.dtype)  # else `ids` are converted
    first, end = np.searchsorted(ids, possible), np.searchsorted(ids, possible, "right")
    return about, first[first < end]


def _read_ids(path: Path) -> tuple[SeedFile, np.ndarray]:
    about, table = read_seed(path, [])
    return about, table.column("level_id").to_numpy()


@cache
def _known_ids(path: Path, _: tuple[int, ...]) -> tuple[SeedFile, np.ndarray]:
    return _read_ids(path)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[SeedFile, Bounded]]:
    """Open a seed file. The block's errors are raised as `read_seed`'s."""
    try:
        with bounded(path, SEEDS) as file:
            metadata = file.metadata
            version = metadata.get(SEED_KEY, b"?").decode()
            if version != SEED_VERSION:
                raise Failure(
                    f"The file {path} is not a seed file that this program reads (its version is {version[:9]!r}, not "
                    f"{SEED_VERSION}): `levelproof export SPLIT --format seed` writes one."
                )
            config_hash = metadata[HASH_KEY].decode()
            config = settings_in(metadata[CONFIG_KEY], config_hash)
            budget, content = metadata[BUDGET_KEY].decode(), json.loads(metadata[CONTENT_KEY])
            if (
                not re.fullmatch(BUDGET, budget)
                or not _are_digests(content)
                or len(content) != -(-file.rows // ROW_GROUP)
            ):
                raise ValueError("its metadata are not those of a seed file")
            fragment = Fragment(path, config_hash, config, {}, file.rows, True, frozenset({STORED}))
            yield SeedFile(fragment, budget, tuple(content)), file
    except FileNotFoundError:
        raise missing_seed(path) from None
    except PermissionError:
        raise Failure(f"The seed file {path} cannot be read: check its permissions.") from None
    except OtherKind:
        whole = f"open the whole split, {path.parent.parent}" if path.parent.name == MANIFEST else OPENED
        raise UserError(f"The file {path} is parquet, but not a seed file: {whole}.") from None
    except DAMAGE as error:
        raise damaged_seed(path, error) from error


def missing_seed(path: Path) -> Failure:
    """Return the Failure for a seed file that does not exist."""
    return Failure(f"There is no seed file {path}: `levelproof export SPLIT --format seed` writes one.")


def damaged_seed(path: Path, error: Exception) -> Failure:
    """Return the Failure for a seed file that raised `error` when it was read."""
    reason = str(error) if type(error) is ValueError else type(error).__name__
    return Failure(f"The seed file {path} is damaged ({reason}): " + mended(path, "copy it again from its source."))


def _are_digests(digests: Any) -> bool:
    return isinstance(digests, list) and all(
        isinstance(one, str) and re.fullmatch("[0-9a-f]{64}", one) for one in digests
    )


def _check(table: pa.Table) -> None:
    """Raise ValueError for values that no seed file has."""
    ids = table.column("level_id").to_numpy()
    if len(ids) and (ids[0] < 0 or ids[-1] > MAX_LEVEL_ID or not (np.diff(ids.astype(np.int64)) > 0).all()):
        raise ValueError("its level ids are not ascending ids of levels")
    columns: dict[str, Any] = {name: table.column(name) for name in table.column_names}
    for name, known in ("label", {*Label}), ("source", {*Source, None}):
        if name in columns and not {*columns[name].unique().to_pylist()} <= known:
            raise ValueError("it has unknown labels or witnesses")
    if "steps_to_goal" in columns:
        steps = columns["steps_to_goal"].drop_null().to_numpy()
        if len(steps) and not 1 <= steps.min() <= steps.max() <= RECORD_STEPS:
            raise ValueError("its witnesses are longer than a record")
    if "witness" in columns:
        _check_lengths(columns["witness"], MAX_BYTES)
    if {"witness", "label", "steps_to_goal", "checksum"} <= columns.keys():
        has = np.isin(np.array(columns["label"].to_pylist(), dtype=object), [*WITNESSED])
        for name in ("witness", "steps_to_goal", "checksum"):
            if (columns[name].is_valid().to_numpy() != has).any():
                raise ValueError("its labels do not match its witnesses")


def _check_lengths(column: pa.ChunkedArray, most: int) -> None:
    for chunk in column.chunks:
        offsets = np.frombuffer(chunk.buffers()[1], np.int32)[chunk.offset : chunk.offset + len(chunk) + 1]
        if (np.diff(offsets) > most).any():
            raise ValueError(f"it has a witness larger than {most} bytes")
