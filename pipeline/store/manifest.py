"""The manifest: a parquet fragment for each work unit, or a sealed one for many, each the commit marker of its levels.

A fragment is written last and appears at once or not at all; readers see only what fragments name.
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

from levelproof.configs.convert import flat
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.store import files
from levelproof.pipeline.store.bounds import with_dictionaries
from levelproof.pipeline.store.checksums import digests_below, with_own
from levelproof.pipeline.store.columns import COLUMNS, MANIFEST_VERSION, schema_of
from levelproof.pipeline.store.disk import flush, flush_entry, regular
from levelproof.pipeline.store.fragment import FULL, Fragment, read_fragment
from levelproof.pipeline.store.layout import FRAGMENT, MANIFEST, Attempt, entries, ids_of
from levelproof.pipeline.store.remote import INDEX, is_remote
from levelproof.pipeline.store.runs import ascending
from levelproof.pipeline.store.schema import CONFIG_KEY, DENSITIES_KEY, DIGESTS_KEY, HASH_KEY, SEALED_KEY, VERSION_KEY
from levelproof.pipeline.store.shown import shown
from levelproof.pipeline.urls import require_known

SHOWN = 6  # differing settings that an error lists
# Fragments read at once: more than cores, because a shared folder takes its time for each; not many more, because what
# reads them waits for Python's lock: of millions of rows 8 take a third longer than 4 on two cores
THREADS = min(max(4, os.cpu_count() or 1), 8)
MANY = 2000  # fragments: to read so many takes seconds
ROW_GROUP = 2**14  # rows that are read together, or not at all; fewer: quicker to find a level, slower to read them all
ROUNDS = 20  # looks at a split that is sealed meanwhile; each takes a moment, and sealing a fragment takes seconds
Each = Callable[[pa.Table], pa.Table]
DATA_COLUMNS = ("shard", "experts")  # name what lies beside the manifest


def begin_fragment(attempt: Attempt) -> None:
    """Note on the disk that an attempt begins to write: what it leaves when it dies can be told from what others own.

    Raises:
        OSError: the disk refuses.
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
    """Commit a unit, or many that are sealed: write their rows to the attempt's fragment, durably and in one step.

    `carried` has the digests of shards and checkpoints that earlier fragments committed and that stay as they are.

    Raises:
        OSError: the disk refuses; no fragment is there then, or the one that was there before.
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
    with open(attempt.begun, "wb", opener=regular) as file:
        file.write(with_own(whole.getvalue().to_pybytes()))
    flush_entry(attempt.begun)
    attempt.begun.replace(attempt.fragment)
    flush_entry(attempt.fragment.parent)  # the new name itself


def settings_metadata(config_hash: str, config: Mapping[str, Any]) -> dict[bytes, bytes]:
    """What tells the settings, and with them the rules, in a parquet file's schema."""
    return {
        VERSION_KEY: str(MANIFEST_VERSION).encode(),
        HASH_KEY: config_hash.encode(),
        CONFIG_KEY: json.dumps(config, sort_keys=True).encode(),
    }


def fragment_paths(split: Path) -> list[Path]:
    """All committed fragments of a split, in the order of their level ids: files with the exact name of one.

    Whatever else is in the folder (copies, links, what file systems and editors leave) is none.
    """
    return sorted(entries(split, MANIFEST, FRAGMENT, DirEntry.is_file))


def write_index(split: Path) -> None:
    """Write down which fragments there are, for readers of a web server that does not list them.

    Raises: as `files.write`.
    """
    files.write(split / MANIFEST / INDEX, "".join(f"{path.name}\n" for path in fragment_paths(split)).encode())


def _any_within(ordered: np.ndarray, first: int, last: int) -> bool:
    low, high = np.searchsorted(ordered, [first, last + 1])
    return bool(low < high)


@dataclass(frozen=True)
class Manifest:
    """Committed rows of a split, sorted by level id; each level once."""

    split: Path
    fragments: tuple[Fragment, ...]  # that were read
    table: pa.Table
    named: Mapping[str, frozenset[str]]  # by column (shard, experts), if it was read: what fragments name that count
    superseded: tuple[Fragment, ...] = ()  # that do not: every level of theirs counts in another one

    @property
    def counting(self) -> list[Fragment]:
        """The fragments of which some row counts."""
        return [fragment for fragment in self.fragments if fragment not in self.superseded]

    @property
    def level_ids(self) -> np.ndarray:
        return self.table.column("level_id").to_numpy()

    @property
    def labels(self) -> np.ndarray:
        labels = self.table.column("label").combine_chunks().dictionary_encode()
        return np.array(labels.dictionary.to_pylist(), dtype=str)[labels.indices.to_numpy()]

    def counts(self, of: np.ndarray) -> dict[str, int]:
        """How many of these rows (a mask) have which label, the most frequent first."""
        found = self.table.column("label").filter(of).value_counts().to_pylist()
        return {of["values"]: of["counts"] for of in sorted(found, key=lambda of: -of["counts"])}

    @property
    def shards(self) -> frozenset[str]:
        """Paths below the split. KeyError where the column was not read."""
        return self.named["shard"]

    @property
    def config(self) -> dict[str, Any] | None:
        """The settings that made it; None while it is empty."""
        return self.fragments[0].config if self.fragments else None

    @property
    def config_hash(self) -> str | None:
        return self.fragments[0].config_hash if self.fragments else None


def read_manifest(
    split: Path | str,
    columns: Sequence[str] | None = None,
    level_ids: Sequence[int] | np.ndarray | None = None,
    *,
    compact: bool = False,
    each: Each | None = None,
) -> Manifest:
    """The manifest of a split, one row for each level that was tried; empty where nothing is committed yet.

    Args:
        split: the folder `{out}/{budget}/{size}`.
        columns: which to read (default: all); `level_id` is always among them.
        level_ids: whose rows (default: all); fragments without any of them, by their names, are not opened.
        compact: columns that are repetitive come as dictionaries: of millions of rows, a tenth of the memory.
        each: what to keep of a fragment's rows, as they come and in threads; `level_id` has to be among it.

    Raises:
        UserError: there is no such column.
        Failure: a fragment is damaged, or fragments of several configurations lie side by side.
    """
    split = Path(split)
    names = COLUMNS.names if columns is None else list(dict.fromkeys(["level_id", *columns]))
    if unknown := [name for name in names if name not in COLUMNS.names]:
        raise UserError(f"There is no column {unknown[0]!r}: the manifest has {', '.join(COLUMNS.names)}.")
    asked = None if level_ids is None else ascending(np.asarray(level_ids, np.int64))
    read = partial(_part, names=names, level_ids=asked, compact=compact, each=each)
    parts = _parts(split, asked, read)
    fragments = tuple(fragment for fragment, _ in parts)
    for fragment in fragments[1:]:
        if fragment.config_hash != fragments[0].config_hash:
            changes = told(differences(fragments[0].config, fragment.config))
            raise Failure(
                f"The split {split} mixes two configurations, {fragments[0].path.name} and {fragment.path.name} "
                f"({changes}): move the fragments of one of them elsewhere, with the shards and experts that are "
                "named after them."
            )
    tables, superseded = [], []
    for neighbours in _overlapping(parts):
        table, without = each_once(neighbours)
        tables.append(table)
        superseded += without
    nothing = schema_of(names, compact).empty_table()
    table = pa.concat_tables([nothing if each is None else each(nothing), *tables]).unify_dictionaries()
    counting = [part for fragment, part in parts if fragment not in superseded]
    named = {name: named_by(counting, name) for name in DATA_COLUMNS if name in table.column_names}
    return Manifest(split, fragments, table, named, tuple(superseded))


def _parts(
    split: Path, level_ids: np.ndarray | None, read: Callable[[Path], tuple[Fragment, pa.Table] | None]
) -> list[tuple[Fragment, pa.Table]]:
    """The fragments and their rows, of these levels (ascending ids; None: of all).

    Who seals removes fragments after there is one that has their levels. So this looks until a look finds no other
    sealed one, and none gone that the look before had: until then a level may have slipped from the one to the other.
    """
    found: dict[tuple[Path, int], tuple[Fragment, pa.Table]] = {}
    with ThreadPoolExecutor(THREADS) as threads:
        for look in range(ROUNDS):
            listed = entries(split, MANIFEST, FRAGMENT, DirEntry.is_file).items()
            new = [one for one in listed if one not in found and _wanted(one[0], level_ids)]
            parts = list(shown(threads.map(read, (path for path, _ in new)), "fragments", len(new), MANY))
            found |= {one: part for one, part in zip(new, parts, strict=True) if part}
            if look and all(part and not part[0].sealed for part in parts):
                latest = {path: part for (path, _), part in found.items()}  # of those that had one name in turn
                return [latest[path] for path in sorted(latest) if latest[path][0].rows]  # others are fences
    raise Failure(f"The fragments of {split} change faster than they can be read: try again when they are at rest.")


def _wanted(path: Path, level_ids: np.ndarray | None) -> bool:
    return level_ids is None or _any_within(level_ids, *ids_of(path))


def _part(
    path: Path, names: Sequence[str], level_ids: np.ndarray | None, compact: bool, each: Each | None
) -> tuple[Fragment, pa.Table] | None:
    """A fragment and its rows; None: it is gone."""
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
    """Groups of fragments, ascending; only those of one group can have a level in common."""
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
    """The rows of these fragments, ascending, each level once; and the fragments of which none is among them.

    What is sealed counts before what is not, and the larger before the smaller.
    """
    ordered = sorted(parts, key=lambda part: (not part[0].sealed, -part[0].rows))
    table = pa.concat_tables([table.replace_schema_metadata(None) for _, table in ordered])
    ids = _ids(table)
    if (np.diff(ids) > 0).all():  # nearly always, and of millions of rows this takes no time
        return table, []
    _, first = np.unique(ids, return_index=True)  # sorts
    ends = np.cumsum([table.num_rows for _, table in ordered])
    counts = np.bincount(np.searchsorted(ends, first, side="right"), minlength=len(ordered))
    return table.take(first), [fragment for (fragment, _), count in zip(ordered, counts, strict=True) if not count]


def named_by(tables: Sequence[pa.Table], column: str) -> frozenset[str]:
    """What rows name in a column: shards or experts."""
    return frozenset(path for table in tables for path in table.column(column).unique().to_pylist() if path)


def data_named_by(rows: pa.Table) -> frozenset[str]:
    """Shards and experts."""
    return frozenset.union(*(named_by([rows], name) for name in DATA_COLUMNS))


def with_places(rows: pa.Table, shards: Sequence[Any], places: Sequence[Any]) -> pa.Table:
    """The same rows, whose data are in these shards now, in these of their rows."""
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
    """As `read_manifest`, for questions about a split that should be there; it may have none of the levels.

    Raises:
        UserError: there is no split here, or nothing is committed in it.
        Failure: as `read_manifest`.
    """
    manifest = read_manifest(split, columns, level_ids, compact=compact, each=each)
    if not manifest.fragments and (level_ids is None or not fragment_paths(split)):
        raise UserError(_nothing_at(split))
    return manifest


def _nothing_at(split: Path) -> str:
    """Why a folder is no split, in a sentence."""
    require_known(split)
    here = [] if is_remote(split) else [f"{above}{MANIFEST}" for above in ("*/", "*/*/", "*/*/*/")]
    below = [found.parent for pattern in here for found in split.glob(pattern)]
    if below:
        names = ", ".join(map(str, sorted(below)[:SHOWN]))
        return f"{split} is no split, but the folder of {len(below)}: name one of them, such as {names}."
    what = f"Nothing is committed in {split} yet" if split.is_dir() else f"There is no split at {split}"
    return f"{what}: give a folder such as data/128k/s that `levelproof generate` made."


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Settings that differ, by their dotted names; `absent` where one side does not have it."""
    a, b = flat(old), flat(new)
    names = sorted(name for name in a.keys() | b.keys() if a.get(name, "absent") != b.get(name, "absent"))
    return {name: (a.get(name, "absent"), b.get(name, "absent")) for name in names}


def told(changes: Mapping[str, tuple[Any, Any]]) -> str:
    """`differences` in words, the first SHOWN of them."""
    shown = [f"{name} was {old}, now {new}" for name, (old, new) in list(changes.items())[:SHOWN]]
    return "; ".join(shown) + (f" and {len(changes) - SHOWN} more" if len(changes) > SHOWN else "")
