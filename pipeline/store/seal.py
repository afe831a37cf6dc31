"""Sealing: neighbouring fragments become one, and their shards one, in the order of level ids.

The new data first, then the new fragment, which counts before those that it was made of; only then do these go. A
process that dies in between leaves what `leftovers.clean` removes. Knows nothing of who seals, and when.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa

from levelproof.configs.schema import Density, stored_as
from levelproof.pipeline.store.checksums import altered
from levelproof.pipeline.store.contents import ContentsError
from levelproof.pipeline.store.convert import convert
from levelproof.pipeline.store.files import remove
from levelproof.pipeline.store.layout import (
    SHARDS,
    Attempt,
    begun_path,
    data_path,
    fragment_of,
    fragment_path,
    new_attempt,
    unit_name,
)
from levelproof.pipeline.store.leases import require_served
from levelproof.pipeline.store.leftovers import disown, drop
from levelproof.pipeline.store.manifest import (
    THREADS,
    Fragment,
    begin_fragment,
    each_once,
    fragment_paths,
    named_by,
    read_fragment,
    with_places,
    write_fragment,
)
from levelproof.pipeline.store.merge import Place, merge_shards
from levelproof.pipeline.store.publish import publishing
from levelproof.pipeline.store.remote import is_remote
from levelproof.pipeline.store.schema import Encoding
from levelproof.pipeline.store.shard import Shard, damaged

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

    Kept experts stay where they are, unread: their digests are carried over. `moved` and `rows_a_file` are those of
    `merge_shards`; `moved` is called before each fragment or shard is opened and before each is removed, too. With a
    `density` and its `key_every`, all shards get that one; `converted` is called with how many levels have.

    Returns:
        The sealed fragment.

    Raises:
        Failure: a fragment or a shard is damaged, or the engine cannot convert it; nothing has changed.
        LeaseLost: another writer has the split now; nothing has changed.
        OSError: the disk refuses; nothing has changed.
    """
    paths = {piece.path for piece in pieces}
    if is_remote(split):
        fragment_paths(split)  # what was known of its files is forgotten
    parts = _read(paths, moved)
    table, about = each_once(parts)[0], parts[0][0]
    shards = {name: data_path(split, name) for name in named_by([of for _, of in parts], "shard")}
    replaced = [shard for shard in shards.values() if fragment_of(shard) in paths]  # no other fragment may name them
    digests = {name: files for of, _ in parts for name, files in of.digests.items()}
    _require_committed(shards, digests)
    places, between = _places(table, shards, moved), list[Path]()
    densities = frozenset([stored_as(*density)]) if density else frozenset().union(*(of.densities for of, _ in parts))
    first, last = (int(table.column("level_id")[i].as_py()) for i in (0, -1))
    unit, count = unit_name(first, last), 1 if density else len(places)
    making = publishing(split, paths) if is_remote(split) else nullcontext(split)  # where the new ones are made
    with making as folder, _attempted(folder, unit, max(count, 1), replaced, between) as attempts:
        if density:
            places = _converted(places, density, lambda: _another(folder, unit, between), converted)
        merged = dict(zip((attempt.shard for attempt in attempts), places.values(), strict=False))
        for shard, of in merged.items():
            merge_shards(shard, of, moved, rows_a_file)
        require_served(folder)
        disown(replaced)
        write_fragment(attempts[0], _moved(table, merged), about.config_hash, about.config, True, densities, digests)
    sealed = fragment_path(split, unit)
    for path in paths - {sealed}:
        moved(0)
        remove(path)
    for shard in replaced:
        moved(0)
        drop(shard)
    return Piece(sealed, table.num_rows, True)


def _read(paths: Iterable[Path], moved: Callable[[int], None]) -> list[tuple[Fragment, pa.Table]]:
    """Fragments with their rows, in the order of level ids."""

    def read(path: Path) -> tuple[Fragment, pa.Table]:
        moved(0)
        return read_fragment(path)

    with ThreadPoolExecutor(THREADS) as threads:
        return list(threads.map(read, sorted(paths)))


def _require_committed(shards: Mapping[str, Path], digests: Mapping[str, Mapping[str, str]]) -> None:
    """Check the metadata of shards against their digests; chunks are checked one by one, as they are copied.

    Raises:
        Failure: some has changed, and the digest of its copy would make that the truth.
    """
    for name, path in shards.items():
        try:
            wrong = altered(path, digests.get(name, {}), "zarr.json")
        except OSError as error:
            raise damaged(path, error) from error
        if wrong:
            raise damaged(path, ContentsError(f"its {wrong[0]} is not what was committed"))


def _places(table: pa.Table, shards: Mapping[str, Path], moved: Callable[[int], None]) -> dict[Encoding, list[Place]]:
    """Where the trajectories of these rows lie, by how they are stored."""
    encodings = {}
    for name, path in shards.items():
        moved(0)
        encodings[name] = Shard(path).encoding
    found: dict[Encoding, list[Place]] = {}
    for name, row, level_id in zip(*(table.column(of).to_pylist() for of in ("shard", "row", "level_id")), strict=True):
        if name:
            found.setdefault(encodings[name], []).append(Place(shards[name], row, level_id))
    return found


@contextmanager
def _attempted(
    split: Path, unit: str, count: int, replaced: Sequence[Path], between: Sequence[Path]
) -> Iterator[list[Attempt]]:
    """Attempts at a sealed unit, a shard each; the fragment is that of the first. If it fails, all is as before.

    Shards `between` are needed meanwhile only, and those that were `replaced` go after the commit.
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
            for mark in [*(attempt.begun for attempt in attempts), *map(begun_path, replaced)]:
                remove(mark)
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


def _moved(table: pa.Table, merged: Mapping[Path, Sequence[Place]]) -> pa.Table:
    """The same rows, with these shards as the places of their levels, one after another."""
    now = {
        of.level_id: (f"{SHARDS}/{shard.name}", row)
        for shard, places in merged.items()
        for row, of in enumerate(places)
    }
    found = [now.get(level_id, (None, None)) for level_id in table.column("level_id").to_pylist()]
    return with_places(table, *zip(*found, strict=True))
