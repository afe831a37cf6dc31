"""Sealing: merging neighbouring fragments into one, and their shards into one, ordered by level id.

The new data is written first, then the new fragment, which takes precedence over its sources; only then are these
removed. If the process dies in between, `leftovers.clean` removes the rest.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from levelproof.configs.schema import Density, stored_as
from levelproof.pipeline.store.bounds import MAX_ROWS
from levelproof.pipeline.store.checksums import altered
from levelproof.pipeline.store.files import remove
from levelproof.pipeline.store.formats import ContentsError, Encoding
from levelproof.pipeline.store.fragment import Fragment, read_fragment
from levelproof.pipeline.store.layout import (
    SHARDS,
    Attempt,
    begun_path,
    data_path,
    fragment_of,
    fragment_path,
    ids_of,
    new_attempt,
    unit_ids,
    unit_name,
)
from levelproof.pipeline.store.leases import require_served
from levelproof.pipeline.store.leftovers import disown, drop
from levelproof.pipeline.store.manifest import (
    THREADS,
    begin_fragment,
    each_once,
    fragment_paths,
    named_by,
    with_places,
    write_fragment,
)
from levelproof.pipeline.store.merge import Place, merge_shards
from levelproof.pipeline.store.publish import publishing
from levelproof.pipeline.store.remote import at_once
from levelproof.pipeline.store.requests import REQUESTS
from levelproof.pipeline.store.shard import Shard, read_together, reading, refuse_unlike, write_shard
from levelproof.pipeline.urls import is_remote

ROWS = 100_000  # rows per sealed fragment, roughly; more: fewer files, but more to rewrite when levels are added
CONVERTED = 256  # levels in memory at a time when their density changes: 300 MB for size l
REMOVED = 64  # fragments or shards that are removed together, before the caller may stop the seal
CROWD = 1_000  # unsealed neighbours that are merged even if they have fewer rows: many small files are slow to read


class Piece(NamedTuple):
    """A fragment's entry in a plan."""

    path: Path  # names sort as level ids do
    rows: int
    sealed: bool

    @staticmethod
    def of(fragment: Fragment) -> "Piece":
        return Piece(fragment.path, fragment.rows, fragment.sealed)


def plan(pieces: Iterable[Piece], rows: int) -> list[list[Piece]]:
    """Group neighbours to merge into fragments of about `rows` rows, at most MAX_ROWS, ascending.

    Only unsealed fragments, and sealed ones with less than half of `rows`, are merged. The last group, and a group
    before a larger sealed fragment, may have fewer rows.
    """
    groups: list[list[Piece]] = [[]]
    count = 0
    for piece in sorted(pieces):
        large = piece.sealed and 2 * piece.rows >= rows
        if large or count >= rows or count + piece.rows > MAX_ROWS:
            groups.append([])
            count = 0
        if not large:
            groups[-1].append(piece)
            count += piece.rows
    return [group for group in groups if len(group) > 1 or any(not piece.sealed for piece in group)]


def due(pieces: Iterable[Piece], rows: int) -> list[list[Piece]]:
    """Return the groups that a running job should merge now: neighbours with enough rows, or crowds."""
    groups = []
    for group in plan(pieces, rows):
        if sum(piece.rows for piece in group) >= rows:
            groups.append(group)
            continue
        runs = (list(run) for sealed, run in groupby(group, lambda piece: piece.sealed) if not sealed)
        groups += [run for run in runs if len(run) >= CROWD]
    return groups


def seal(
    split: Path,
    pieces: Sequence[Piece],
    moved: Callable[[int], None] = lambda _: None,
    rows_a_file: int | None = None,
    density: tuple[Density, int] | None = None,
    converted: Callable[[int], None] = lambda _: None,
) -> Piece:
    """Merge fragments, and their shards of each density. The caller must be the split's writer.

    Kept experts are neither read nor moved: their digests are copied.

    Args:
        split: folder or store.
        pieces: fragments to merge.
        moved: as in `merge_shards`; also called with 0 before each fragment or shard is opened or removed.
        rows_a_file: as in `merge_shards`.
        density: density and `key_every` to which all shards are converted; default: keep each one's.
        converted: called with the number of levels just converted.

    Returns:
        The sealed fragment.

    Raises:
        Failure: a fragment or a shard is damaged, the engine cannot convert it, or the sealed fragment would be too
            large to be read; nothing has changed.
        LeaseLost, OSError: another writer has the split now, or the write fails; nothing has changed.
    """
    paths = {piece.path for piece in pieces}
    if is_remote(split):
        fragment_paths(split)  # drops cached metadata of its files
    parts = _read(split, paths, moved)
    table, about = each_once(parts)[0], parts[0][0]
    shards = {name: data_path(split, name) for name in named_by([rows for _, rows in parts], "shard")}
    replaced = _replaced(split, shards, paths)
    digests = {name: files for fragment, _ in parts for name, files in fragment.digests.items()}
    encodings = _committed_encodings(split, shards, digests, moved)
    places, between, disowned = _places(table, shards, encodings), list[Path](), list[Path]()
    densities = frozenset([stored_as(*density)]) if density else frozenset().union(*(one.densities for one, _ in parts))
    first, last = (int(table.column("level_id")[i].as_py()) for i in (0, -1))
    unit, count = unit_name(first, last), 1 if density else len(places)
    making = publishing(split, paths) if is_remote(split) else nullcontext(split)  # where new data is written
    with making as folder, _attempted(folder, unit, max(count, 1), disowned, between) as attempts:
        if density:
            places = _converted(places, density, lambda: _another(folder, unit, between), converted)
        merged = dict(zip((attempt.shard for attempt in attempts), places.values(), strict=False))
        for shard, sources in merged.items():
            merge_shards(shard, sources, moved, rows_a_file)
        require_served(split)
        disowned += replaced
        disown(replaced)
        write_fragment(attempts[0], _moved(table, merged), about.config_hash, about.config, True, densities, digests)
    sealed = fragment_path(split, unit)
    for old, gone in (sorted(paths - {sealed}), remove), (replaced, drop):
        for first in range(0, len(old), REMOVED):
            moved(0)
            gone(*old[first : first + REMOVED])
    return Piece(sealed, table.num_rows, True)


def _read(split: Path, paths: Iterable[Path], moved: Callable[[int], None]) -> list[tuple[Fragment, pa.Table]]:
    """Read fragments with their rows, ordered by level ids."""

    def read(path: Path) -> tuple[Fragment, pa.Table]:
        moved(0)
        return read_fragment(path)

    with ThreadPoolExecutor(REQUESTS if is_remote(split) else THREADS) as threads:
        return list(threads.map(read, sorted(paths)))


def _replaced(split: Path, shards: Mapping[str, Path], paths: Collection[Path]) -> list[Path]:
    """Select the shards that no fragment but those at `paths` names.

    Names say so, unless a repair has renamed the fragment of a shard, or has died before it removed the old one.
    """
    elsewhere = {name: shard for name, shard in shards.items() if fragment_of(shard) not in paths}
    units = [unit_ids(shard) for shard in elsewhere.values()]
    others = [path for path in fragment_paths(split) if path not in paths] if elsewhere else []
    overlap = (path for path in others if any(a <= ids_of(path)[1] and ids_of(path)[0] <= b for a, b in units))
    named = named_by([read_fragment(path, ["shard"])[1] for path in overlap], "shard")
    return [shard for name, shard in shards.items() if name not in elsewhere or name not in named]


def _committed_encodings(
    split: Path, shards: Mapping[str, Path], digests: Mapping[str, Mapping[str, str]], moved: Callable[[int], None]
) -> dict[str, Encoding]:
    """Return the encodings of shards, whose metadata must have their digests; chunks are checked as they are copied.

    Raises:
        Failure: metadata has changed; a merged shard would have a valid digest over the change.
    """

    def encoding(name: str) -> Encoding:
        moved(0)
        with reading(shards[name]):
            if wrong := altered(shards[name], digests.get(name, {}), "zarr.json"):
                raise ContentsError(f"its {wrong[0]} is not what was committed")
        return Shard(shards[name]).encoding

    return dict(zip(shards, at_once(split, encoding, shards), strict=True))


def _places(
    table: pa.Table, shards: Mapping[str, Path], encodings: Mapping[str, Encoding]
) -> dict[Encoding, list[Place]]:
    """Return the places of these rows' trajectories, by encoding."""
    by_encoding: dict[Encoding, list[Place]] = {}
    columns = (table.column(column).to_pylist() for column in ("shard", "row", "level_id"))
    for name, row, level_id in zip(*columns, strict=True):
        if name:
            by_encoding.setdefault(encodings[name], []).append(Place(shards[name], row, level_id))
    return by_encoding


@contextmanager
def _attempted(
    split: Path, unit: str, count: int, disowned: Sequence[Path], between: Sequence[Path]
) -> Iterator[list[Attempt]]:
    """Yield `count` attempts at a sealed unit, one per shard; the first one's fragment commits.

    An exception in the block leaves the split as it was, without the marks of the shards that the block has `disowned`.
    Intermediate shards `between` are removed at the end of the block.
    """
    attempts = [new_attempt(split, unit) for _ in range(count)]
    try:
        for attempt in attempts:
            begin_fragment(attempt)
        yield attempts
    except BaseException:
        if attempts[0].begun.exists():  # not committed
            for attempt in attempts:
                drop(attempt.shard)
            remove(*map(begun_path, disowned))  # `drop` removed those of the new shards, unless a shard stays
        raise
    finally:
        for shard in between:
            drop(shard)
    for attempt in attempts[1:]:
        attempt.begun.unlink()


def _converted(
    places: Mapping[Encoding, list[Place]],
    density: tuple[Density, int],
    another: Callable[[], Path],
    converted: Callable[[int], None],
) -> dict[Encoding, list[Place]]:
    """Convert trajectories of other densities to new shards; return the places of all, ordered by level id."""
    all_places, wanted = [], None
    for encoding, sources in places.items():
        wanted = replace(encoding, density=density[0], key_every=density[1])
        if encoding.as_json() == wanted.as_json():
            all_places += sources
            continue
        for some in convert(sources, *density, another):
            all_places += some
            converted(len(some))
    return {wanted: sorted(all_places, key=lambda place: place.level_id)} if wanted else {}


def convert(
    places: Sequence[Place], density: Density, key_every: int, another: Callable[[], Path]
) -> Iterator[list[Place]]:
    """Write trajectories in another density, at most CONVERTED to a new shard, durably.

    Args:
        places: shards and rows of the trajectories, which have one size and one set of rules.
        density: density of the new shards.
        key_every: env steps between key frames of `witness`.
        another: returns the path of the next new shard.

    Yields:
        The new places, shard after shard.

    Raises:
        Failure: a shard is damaged, or the engine on this machine computes states that differ from the stored ones.
        OSError: the write fails.
    """
    for first in range(0, len(places), CONVERTED):
        some = places[first : first + CONVERTED]
        by_shard = groupby(some, lambda place: place.shard)
        parts = [(Shard(path), [place.row for place in group]) for path, group in by_shard]
        arrays = {name: np.moveaxis(x, 0, -1) for name, x in read_together(parts, report=refuse_unlike).items()}
        encoding, path = replace(parts[0][0].encoding, density=density, key_every=key_every), another()
        write_shard(path, [place.level_id for place in some], arrays, encoding)
        yield [Place(path, row, place.level_id) for row, place in enumerate(some)]


def _another(split: Path, unit: str, between: list[Path]) -> Path:
    """Begin an intermediate shard, needed until its trajectories are merged, and return its path."""
    attempt = new_attempt(split, unit)
    begin_fragment(attempt)
    between.append(attempt.shard)
    return attempt.shard


def _moved(table: pa.Table, merged: Mapping[Path, Sequence[Place]]) -> pa.Table:
    """Replace the places in these rows by those in the merged shards."""
    now = {
        place.level_id: (f"{SHARDS}/{shard.name}", row)
        for shard, places in merged.items()
        for row, place in enumerate(places)
    }
    placed = [now.get(level_id, (None, None)) for level_id in table.column("level_id").to_pylist()]
    return with_places(table, *zip(*placed, strict=True))
