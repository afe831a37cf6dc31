"""The manifest: a parquet fragment per work unit, or a sealed one for many, each the commit marker of its levels.

A fragment is written last and appears whole or not at all; readers see only what fragments name.
"""

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from os import DirEntry
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import Console

from levelproof.configs.convert import flat
from levelproof.configs.schema import is_grown
from levelproof.experts.config import RECORD_STEPS
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.store import files
from levelproof.pipeline.store.bounds import Bounded, with_dictionaries
from levelproof.pipeline.store.checksums import digests_below, with_own
from levelproof.pipeline.store.columns import COLUMNS, MANIFEST_VERSION, schema_of
from levelproof.pipeline.store.disk import flush, flush_entry, regular
from levelproof.pipeline.store.formats import CONFIG_KEY, DENSITIES_KEY, DIGESTS_KEY, HASH_KEY, SEALED_KEY, VERSION_KEY
from levelproof.pipeline.store.fragment import FULL, Fragment, read_fragment
from levelproof.pipeline.store.layout import FRAGMENT, JOB, MANIFEST, Attempt, entries, ids_of
from levelproof.pipeline.store.progress_bar import ProgressBar
from levelproof.pipeline.store.remote import INDEX, is_listed, stale_index
from levelproof.pipeline.store.runs import ascending, within
from levelproof.pipeline.store.seed.file import is_seed
from levelproof.pipeline.store.seed.rows import seed_parts
from levelproof.pipeline.urls import is_remote, quoted, require_known

MAX_SHOWN = 6  # differing settings that an error lists
# Fragments read at once: more than cores, because shared folders have latency; not many more, because threads wait for
# Python's lock: for millions of rows on two cores, 8 threads take a third longer than 4
THREADS = min(max(4, os.cpu_count() or 1), 8)
MANY = 2000  # fragments that take seconds to read, so a bar is shown
ROW_GROUP = 2**14  # rows read together or skipped; fewer: faster to find one level, slower to read all
MAX_LISTINGS = 20  # of a split that is being sealed; each takes a moment, sealing a fragment takes seconds
Each = Callable[[pa.Table], pa.Table]
DATA_COLUMNS = ("shard", "experts")  # paths of data outside of the manifest


def begin_fragment(attempt: Attempt) -> None:
    """Write an attempt's mark to the disk: if the attempt dies, the mark identifies what it left.

    Raises:
        OSError: the write fails.
    """
    attempt.begun.parent.mkdir(parents=True, exist_ok=True)
    attempt.begun.touch(exist_ok=False)
    flush(attempt.begun)


def write_fragment(
    attempt: Attempt,
    rows: Sequence[Mapping[str, Any]] | pa.Table,
    config_hash: str,
    config: Mapping[str, Any],
    sealed: bool = False,
    densities: Iterable[str] = FULL,
    carried: Mapping[str, dict[str, str]] | None = None,
) -> None:
    """Commit a unit, or several as a sealed one: write rows to the attempt's fragment, durably and in one step.

    `carried` has the digests of shards and checkpoints that earlier fragments committed and that do not change.

    Raises:
        Failure: the fragment would be too large to be read; nothing is written.
        OSError: the write fails; an earlier fragment, if any, stays.
    """
    is_table = isinstance(rows, pa.Table)
    table: Any = rows if is_table else pa.Table.from_pylist([dict(row) for row in rows], schema=COLUMNS)
    names = data_named_by(table)
    metadata = settings_metadata(config_hash, config) | {
        DENSITIES_KEY: json.dumps(sorted(densities)).encode(),
        DIGESTS_KEY: json.dumps(digests_below(attempt.fragment.parent.parent, names, carried or {})).encode(),
    }
    metadata |= {SEALED_KEY: b"1"} if sealed else {}
    table = table.replace_schema_metadata(metadata)
    whole = pa.BufferOutputStream()
    how: Any = {"compression": "zstd", "use_dictionary": with_dictionaries(), "write_page_checksum": True}
    pq.write_table(table, whole, row_group_size=ROW_GROUP, **how)
    data = with_own(whole.getvalue().to_pybytes())
    _require_readable(data, attempt.fragment)
    with open(attempt.begun, "wb", opener=regular) as file:
        file.write(data)
    flush_entry(attempt.begun)
    attempt.begun.replace(attempt.fragment)
    flush_entry(attempt.fragment.parent)  # makes the fragment's name durable


def _require_readable(data: bytes, path: Path) -> None:
    """Raise Failure if readers would refuse this fragment: what it replaces must stay."""
    try:
        Bounded(pa.BufferReader(data))
    except ValueError as error:
        raise Failure(
            f"The fragment {path} would be too large to be read ({error}): use a smaller --rows to seal, or a smaller "
            "unit to generate."
        ) from None


def settings_metadata(config_hash: str, config: Mapping[str, Any]) -> dict[bytes, bytes]:
    """Return the metadata of a parquet schema that holds the settings, which include the task's rules."""
    return {
        VERSION_KEY: str(MANIFEST_VERSION).encode(),
        HASH_KEY: config_hash.encode(),
        CONFIG_KEY: json.dumps(config, sort_keys=True).encode(),
    }


def fragment_paths(split: Path) -> list[Path]:
    """List all committed fragments of a split, ordered by level ids.

    Only files with a fragment's exact name count, not copies, links, or what file systems and editors leave.
    """
    return sorted(entries(split, MANIFEST, FRAGMENT, DirEntry.is_file))


def index_of(split: Path) -> bytes:
    """Return the content of the file that lists the fragments, for readers of web servers, which do not list files."""
    return "".join(f"{path.name}\n" for path in fragment_paths(split)).encode()


def write_index(split: Path) -> None:
    """Write that file durably. Raises: as `files.write`."""
    files.write(split / MANIFEST / INDEX, index_of(split), durable=True)


@dataclass(frozen=True)
class Manifest:
    """Committed rows of a split, sorted by level id; each level once."""

    split: Path
    fragments: tuple[Fragment, ...]  # all that were read
    table: pa.Table
    named: Mapping[str, frozenset[str]]  # by column (shard, experts), if read: paths that this table's fragments name
    superseded: tuple[Fragment, ...] = ()  # no rows in the table: other fragments have all their levels

    @property
    def counting(self) -> list[Fragment]:
        """Fragments with at least one row in the table."""
        return [fragment for fragment in self.fragments if fragment not in self.superseded]

    @property
    def level_ids(self) -> np.ndarray:
        return self.table.column("level_id").to_numpy()

    @property
    def labels(self) -> np.ndarray:
        labels = self.table.column("label").combine_chunks().dictionary_encode()
        return np.array(labels.dictionary.to_pylist(), dtype=str)[labels.indices.to_numpy()]

    def counts(self, mask: np.ndarray) -> dict[str, int]:
        """Count the labels of the rows in `mask`, the most frequent first."""
        counted = self.table.column("label").filter(mask).value_counts().to_pylist()
        return {entry["values"]: entry["counts"] for entry in sorted(counted, key=lambda entry: -entry["counts"])}

    @property
    def shards(self) -> frozenset[str]:
        """Paths of shards below the split. KeyError: the column was not read."""
        return self.named["shard"]

    @property
    def config(self) -> dict[str, Any] | None:
        """Settings that made the split; None if it is empty."""
        return self.fragments[0].config if self.fragments else None

    @property
    def repeats(self) -> bool:
        """Whether records repeat their first episode, without costs: in seeds, and in splits grown from them."""
        return is_grown(self.config or {})

    @property
    def transitions(self) -> int:
        """Env steps of all records, without repetitions. KeyError: `shard` or `steps_to_goal` was not read."""
        if self.repeats:
            return int(np.nansum(self.table["steps_to_goal"].to_numpy()))
        return (self.table.num_rows - self.table["shard"].null_count) * RECORD_STEPS

    @property
    def config_hash(self) -> str | None:
        return self.fragments[0].config_hash if self.fragments else None


def read_manifest(
    split: Path | str,
    columns: Sequence[str] | str | None = None,
    level_ids: Sequence[int] | np.ndarray | None = None,
    *,
    compact: bool = False,
    each: Each | None = None,
) -> Manifest:
    """Read the manifest of a split, one row per level that was tried; empty if nothing is committed yet.

    Args:
        split: the folder `{out}/{budget}/{size}`, or a seed file, or a folder of seed files.
        columns: columns to read, or one (default: all); `level_id` is always included.
        level_ids: levels to read (default: all); fragments whose name excludes all of them are not opened.
        compact: return repetitive columns as dictionaries, which for millions of rows take a tenth of the memory.
        each: reduces each fragment's rows, in threads; must keep `level_id`.

    Raises:
        UserError: there is no such column.
        Failure: a fragment is damaged, or fragments have different configurations.
    """
    split, columns = Path(split), [columns] if isinstance(columns, str) else columns
    names = COLUMNS.names if columns is None else list(dict.fromkeys(["level_id", *columns]))
    if unknown := [name for name in names if name not in COLUMNS.names]:
        raise UserError(f"There is no column {unknown[0]!r}: the manifest has {', '.join(COLUMNS.names)}.")
    requested = None if level_ids is None else ascending(np.asarray(level_ids, np.int64))
    if is_seed(split):
        parts = seed_parts(split, names, requested, compact, each)
    else:
        parts = _parts(split, requested, partial(_part, names=names, level_ids=requested, compact=compact, each=each))
    fragments = tuple(fragment for fragment, _ in parts)
    for fragment in fragments[1:]:
        if fragment.config_hash != fragments[0].config_hash:
            changes = changes_text(differences(fragments[0].config, fragment.config))
            raise Failure(
                f"The split {split} mixes the configurations of {fragments[0].path.name} and {fragment.path.name} "
                f"({changes}): move the fragments of one of them elsewhere, with their shards and experts of the same "
                "names."
            )
    tables, superseded = [], []
    for neighbours in _overlapping(parts):
        table, empty = each_once(neighbours)
        tables.append(table)
        superseded += empty
    nothing = schema_of(names, compact).empty_table()
    table = pa.concat_tables([nothing if each is None else each(nothing), *tables]).unify_dictionaries()
    counting = [part for fragment, part in parts if fragment not in superseded]
    named = {name: named_by(counting, name) for name in DATA_COLUMNS if name in table.column_names}
    return Manifest(split, fragments, table, named, tuple(superseded))


def _parts(
    split: Path, level_ids: np.ndarray | None, read: Callable[[Path], tuple[Fragment, pa.Table] | None]
) -> list[tuple[Fragment, pa.Table]]:
    """Read the fragments and their rows, of these levels (ascending ids; None: of all).

    A seal removes fragments once a sealed one has their levels, so a level may move between two fragments unseen. This
    lists the folder again until a listing finds no new sealed fragment, and no listed one that is missing when read.
    """
    parts_read: dict[tuple[Path, int], tuple[Fragment, pa.Table]] = {}
    missing: list[Path] = []
    with ThreadPoolExecutor(THREADS) as threads:
        for listing in range(MAX_LISTINGS):
            listed = entries(split, MANIFEST, FRAGMENT, DirEntry.is_file).items()
            new = [entry for entry in listed if entry not in parts_read and _wanted(entry[0], level_ids)]
            with ProgressBar("fragments", len(new), Console(stderr=True) if len(new) >= MANY else None) as bar:
                parts = []
                for part in threads.map(read, (path for path, _ in new)):
                    parts.append(part)
                    bar.advance(1)
            missing = [path for (path, _), part in zip(new, parts, strict=True) if not part]
            parts_read |= {entry: part for entry, part in zip(new, parts, strict=True) if part}
            if listing and all(part and not part[0].sealed for part in parts):
                latest = {path: part for (path, _), part in parts_read.items()}  # a path's file may have been replaced
                return [latest[path] for path in sorted(latest) if latest[path][0].rows]  # fences have no rows
    if missing and not is_listed(split):
        raise Failure(stale_index(missing[0]))
    raise Failure(f"The fragments of {split} change faster than they can be read: try again after the writer ends.")


def _wanted(path: Path, level_ids: np.ndarray | None) -> bool:
    return level_ids is None or len(within(level_ids, *ids_of(path))) > 0


def _part(
    path: Path, names: Sequence[str], level_ids: np.ndarray | None, compact: bool, each: Each | None
) -> tuple[Fragment, pa.Table] | None:
    """Read a fragment and its rows, of these levels (ascending ids; None: of all); None: it is missing."""
    if level_ids is not None:
        level_ids = within(level_ids, *ids_of(path))  # comparing a fragment's ids with millions takes seconds
    try:
        fragment, table = read_fragment(path, names, level_ids, compact)
    except FileNotFoundError:
        return None
    table = table.select(names).cast(schema_of(names, compact)).unify_dictionaries()
    if level_ids is not None:
        table = table.filter(np.isin(_ids(table), level_ids))
    return fragment, table if each is None else each(table)


def _ids(table: pa.Table) -> np.ndarray:
    return table.column("level_id").to_numpy()


def _overlapping(parts: Sequence[tuple[Fragment, pa.Table]]) -> Iterator[list[tuple[Fragment, pa.Table]]]:
    """Yield groups of fragments, ascending; fragments of different groups share no level."""
    within = [(_ids(table).min(), _ids(table).max(), i) for i, (_, table) in enumerate(parts) if table.num_rows]
    group, end = [], -1
    for first, last, i in sorted(within):
        if group and first > end:
            yield group
            group = []
        group.append(parts[i])
        end = max(end, last)
    if group:
        yield group


def each_once(parts: Sequence[tuple[Fragment, pa.Table]]) -> tuple[pa.Table, list[Fragment]]:
    """Merge the rows of fragments, ascending, each level once; also return the fragments that contribute none.

    Sealed fragments take precedence, then larger ones.
    """
    ordered = sorted(parts, key=lambda part: (not part[0].sealed, -part[0].rows))
    table = pa.concat_tables([table.replace_schema_metadata(None) for _, table in ordered])
    ids = _ids(table)
    if (np.diff(ids) > 0).all():  # the common case, and fast for millions of rows
        return table, []
    _, first = np.unique(ids, return_index=True)  # sorts
    ends = np.cumsum([table.num_rows for _, table in ordered])
    counts = np.bincount(np.searchsorted(ends, first, side="right"), minlength=len(ordered))
    return table.take(first), [fragment for (fragment, _), count in zip(ordered, counts, strict=True) if not count]


def named_by(tables: Sequence[pa.Table], column: str) -> frozenset[str]:
    """Collect the paths in a column (shard or experts) of these tables."""
    return frozenset(path for table in tables for path in table.column(column).unique().to_pylist() if path)


def data_named_by(rows: pa.Table) -> frozenset[str]:
    """Collect the paths of shards and experts in these rows."""
    return frozenset.union(*(named_by([rows], name) for name in DATA_COLUMNS))


def with_places(rows: pa.Table, shards: Sequence[Any], places: Sequence[Any]) -> pa.Table:
    """Replace the shards and the indices in them (`places`) at which the rows' data lie."""
    for name, values in ("shard", shards), ("row", places):
        field = COLUMNS.field(name)
        rows = rows.set_column(rows.schema.get_field_index(name), field, pa.array(values, field.type))
    return rows


def require_manifest(
    split: Path,
    columns: Sequence[str] | None = None,
    level_ids: Sequence[int] | np.ndarray | None = None,
    *,
    compact: bool = False,
    each: Each | None = None,
) -> Manifest:
    """Read a manifest as `read_manifest`, but require a split; it may have none of the levels.

    Raises:
        UserError: there is no split here, or nothing is committed in it.
        Failure: as `read_manifest`.
    """
    manifest = read_manifest(split, columns, level_ids, compact=compact, each=each)
    if not manifest.fragments and (level_ids is None or not fragment_paths(split)):
        raise UserError(_nothing_at(split))
    return manifest


def refuse_folder_of_splits(folder: Path) -> None:
    """Raise UserError if a local folder contains splits one to three folders down; do not search below a URL."""
    patterns = [] if is_remote(folder) else [f"{above}{MANIFEST}" for above in ("*/", "*/*/", "*/*/*/")]
    below = sorted(path.parent for pattern in patterns for path in folder.glob(pattern))
    if below:
        names = ", ".join(map(str, below[:MAX_SHOWN]))
        raise UserError(f"{folder} is not a split, but a folder of {len(below)}: name one of them, such as {names}.")


def _nothing_at(split: Path) -> str:
    """Say in a sentence why a folder is not a split; raise UserError if it holds some."""
    require_known(split)
    refuse_folder_of_splits(split)
    if not is_remote(split) and (split / JOB).exists():
        return f"Nothing is committed in {split} yet: `levelproof status {quoted(split)}` shows its progress."
    what = f"Nothing is committed in {split} yet" if split.is_dir() else f"There is no split at {split}"
    return f"{what}: give a folder such as data/128k/s that `levelproof generate` made."


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Return old and new value of settings that differ, by dotted name; `absent` if one side lacks it."""
    a, b = flat(old), flat(new)
    names = sorted(name for name in a.keys() | b.keys() if a.get(name, "absent") != b.get(name, "absent"))
    return {name: (a.get(name, "absent"), b.get(name, "absent")) for name in names}


def changes_text(changes: Mapping[str, tuple[Any, Any]]) -> str:
    """Describe the first MAX_SHOWN of `differences`."""
    parts = [f"{name} was {old}, now {new}" for name, (old, new) in list(changes.items())[:MAX_SHOWN]]
    return "; ".join(parts) + (f" and {len(changes) - MAX_SHOWN} more" if len(changes) > MAX_SHOWN else "")
