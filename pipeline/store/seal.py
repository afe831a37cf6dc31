"""Sealing: neighbouring fragments become one, and their shards one, in the order of level ids.

The new data first, then the new fragment, which counts before those that it was made of; only then do these go. A
process that dies in between leaves what `leftovers.clean` removes. Knows nothing of who seals, and when.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa

from configs.schema import Density, stored_as
from pipeline.store.convert import convert
from pipeline.store.layout import SHARDS, begun_path, data_path, fragment_of, new_attempt, unit_name
from pipeline.store.leftovers import disown, drop
from pipeline.store.manifest import (
    THREADS,
    Fragment,
    begin_fragment,
    each_once,
    named_by,
    read_fragment,
    write_fragment,
)
from pipeline.store.merge import Place, merge_shards
from pipeline.store.schema import COLUMNS, Encoding
from pipeline.store.shard import Shard

ROWS = 100_000  # of a sealed fragment, about; more: fewer files, and more to write again when some are added
CROWD = 1_000  # unsealed neighbours that are merged, although they have not as many rows: small files are slow to read


class Piece(NamedTuple):
    """A fragment, as a plan knows it."""

    path: Path  # whose names sort as ids do
    rows: int
    sealed: bool

    @staticmethod
    def of(fragment: Fragment) -> "Piece":
        return Piece(fragment.path, fragment.rows, fragment.sealed)


def plan(pieces: Iterable[Piece], rows: int) -> list[list[Piece]]:
    """What to merge into fragments of about so many rows, ascending: neighbours that are unsealed, or sealed with less
    than half of that. The last before a larger one, or of all, may have less together.
    """
    groups: list[list[Piece]] = [[]]
    count = 0
    for piece in sorted(pieces):
        large = piece.sealed and 2 * piece.rows >= rows
        if large or count >= rows:
            groups.append([])
            count = 0
        if not large:
            groups[-1].append(piece)
            count += piece.rows
    return [group for group in groups if len(group) > 1 or any(not piece.sealed for piece in group)]


def due(pieces: Iterable[Piece], rows: int) -> list[Piece] | None:
    """What a job that is under way should merge now: neighbours with enough rows, or a crowd. None: nothing yet."""
    for group in plan(pieces, rows):
        if sum(piece.rows for piece in group) >= rows:
            return group
        for sealed, run in groupby(group, lambda piece: piece.sealed):
            if not sealed and len(crowd := list(run)) >= CROWD:
                return crowd
    return None


def seal(
    split: Path,
    pieces: Sequence[Piece],
    moved: Callable[[int], None] = lambda _: None,
    rows_a_file: int | None = None,
    density: tuple[Density, int] | None = None,
    converted: Callable[[int], None] = lambda _: None,
) -> Piece:
    """Merge these fragments, and their shards of each density. Only the writer of a split may.

    Kept experts stay where they are. `moved` and `rows_a_file` are those of `merge_shards`; `moved` is called before
    each fragment is read, too. With a `density` and its `key_every`, all shards get that one;
    `converted` is called with how many levels have.

    Returns:
        The sealed fragment.

    Raises:
        Failure: a fragment or a shard is damaged, or the engine cannot convert it; nothing has changed.
        OSError: the disk refuses; nothing has changed.
    """

    def read(path: Path) -> tuple[Fragment, pa.Table]:
        moved(0)
        return read_fragment(path)

    paths = {piece.path for piece in pieces}
    with ThreadPoolExecutor(THREADS) as threads:
        parts = list(threads.map(read, sorted(paths)))
    table, _ = each_once(parts)
    level_ids, rows = (table.column(name).to_pylist() for name in ("level_id", "row"))
    shards = {name: data_path(split, name) for name in named_by([of for _, of in parts], "shard")}
    encodings = {name: Shard(path).encoding for name, path in shards.items()}
    places: dict[Encoding, list[Place]] = {}
    for name, row, level_id in zip(table.column("shard").to_pylist(), rows, level_ids, strict=True):
        if name:
            places.setdefault(encodings[name], []).append(Place(shards[name], row, level_id))
    replaced = [shard for shard in shards.values() if fragment_of(shard) in paths]  # no other fragment may name them
    unit, about = unit_name(level_ids[0], level_ids[-1]), parts[0][0]
    densities = frozenset([stored_as(*density)]) if density else frozenset().union(*(of.densities for of, _ in parts))
    count = len(places) if density is None else 1
    attempts = [new_attempt(split, unit) for _ in range(count or 1)]  # nearly always one
    attempt, between = attempts[0], list[Path]()
    try:
        for each in attempts:
            begin_fragment(each)
        if density:
            places = _converted(places, density, lambda: _another(split, unit, between), converted)
        for each, of in zip(attempts, places.values(), strict=False):
            merge_shards(each.shard, of, moved, rows_a_file)
        disown(replaced)
        merged = {each.shard.name: of for each, of in zip(attempts, places.values(), strict=False)}
        write_fragment(attempt, _moved(table, merged), about.config_hash, about.config, True, densities)
    except BaseException:
        if attempt.begun.exists():  # not committed
            for each in attempts:
                drop(each.shard)
            for mark in [*(each.begun for each in attempts), *map(begun_path, replaced)]:
                mark.unlink(missing_ok=True)
        raise
    finally:
        for shard in between:
            drop(shard)
    for each in attempts[1:]:
        each.begun.unlink()
    for path in paths - {attempt.fragment}:
        path.unlink(missing_ok=True)
    for shard in replaced:
        drop(shard)
    return Piece(attempt.fragment, len(level_ids), True)


def _converted(
    places: Mapping[Encoding, list[Place]],
    density: tuple[Density, int],
    another: Callable[[], Path],
    converted: Callable[[int], None],
) -> dict[Encoding, list[Place]]:
    """Where all of them lie when those of another density are written again, in the order of level ids."""
    found, wanted = [], None
    for encoding, of in places.items():
        wanted = replace(encoding, density=density[0], key_every=density[1])
        if encoding.as_json() == wanted.as_json():
            found += of
            continue
        for some in convert(of, *density, another):
            found += some
            converted(len(some))
    return {wanted: sorted(found, key=lambda place: place.level_id)} if wanted else {}


def _another(split: Path, unit: str, between: list[Path]) -> Path:
    """A shard that is needed until its trajectories are merged."""
    attempt = new_attempt(split, unit)
    begin_fragment(attempt)
    between.append(attempt.shard)
    return attempt.shard


def _moved(table: pa.Table, merged: Mapping[str, Sequence[Place]]) -> pa.Table:
    """The same rows, with these shards as the places of their levels, one after another."""
    now = {of.level_id: (f"{SHARDS}/{name}", row) for name, places in merged.items() for row, of in enumerate(places)}
    found = [now.get(level_id, (None, None)) for level_id in table.column("level_id").to_pylist()]
    for name, values in zip(("shard", "row"), zip(*found, strict=True), strict=True):
        field = COLUMNS.field(name)
        table = table.set_column(COLUMNS.names.index(name), field, pa.array(values, field.type))
    return table
