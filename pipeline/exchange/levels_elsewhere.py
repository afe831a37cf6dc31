"""Completing seed files that were exported without levels, from a folder of level files."""

from collections.abc import Iterator, Mapping
from itertools import count
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from levelproof.configs.schema import from_files
from levelproof.experts.witness.episode import play_episodes
from levelproof.levelgen.files.entries import LevelFileError
from levelproof.levelgen.files.level_file import read_level_file
from levelproof.levelgen.identity.content import content_hashes, level_id_for
from levelproof.levelgen.level import Level, concatenate_levels, name_of
from levelproof.levelgen.sampling.sampler import CHUNK
from levelproof.physics.step import ENGINE_VERSION
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.exchange.seed import check_new_seed
from levelproof.pipeline.read.level_files import level_file_paths
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store import files
from levelproof.pipeline.store.created import writing_to
from levelproof.pipeline.store.origins import can_be_noted
from levelproof.pipeline.store.seed.columns import ROW_GROUP, SCHEMA
from levelproof.pipeline.store.seed.file import SeedFile, damaged_seed, read_seed, seed_files
from levelproof.pipeline.store.seed.packed import unpack_witnesses
from levelproof.pipeline.store.seed.source import LevelSource
from levelproof.pipeline.store.seed.worlds import pack_worlds
from levelproof.pipeline.store.seed.write import content_digest, seed_bytes
from levelproof.pipeline.urls import as_typed
from levelproof.pipeline.words import many


class FoundLevel(NamedTuple):
    """A level of a level file."""

    content_hash: str
    file: str  # absolute path
    level: Level


def add_levels(seed: Path, folder: Path, out: Path) -> None:
    """Write a seed file that lacks its levels to a new one that contains them; print a summary.

    Args:
        seed: a seed file that was exported without its levels.
        folder: level files anywhere below it; files of other levels are ignored.
        out: the new file.

    Raises:
        UserError: `seed` is not one seed file, has its levels, or samples them from their ids; the folder lacks one of
            them; or `out` exists or is not named as seed files are.
        Failure: the seed file is damaged, the levels are not those that it was written from, or a witness does not
            solve its level.
    """
    check_new_seed(out)
    paths = seed_files(seed)
    if len(paths) != 1:
        raise UserError(f"{as_typed(seed)} is not one seed file: --levels completes one file at a time.")
    about, table = read_seed(paths[0], SCHEMA.names)
    if not from_files(about.fragment.config):
        raise UserError(f"The levels of {as_typed(seed)} are sampled from their ids: leave out --levels.")
    if not table["content"].null_count:
        raise UserError(f"{as_typed(seed)} has its levels: leave out --levels.")
    prepare_jax()
    found = _levels_below(folder, str(about.fragment.config["size"]))
    lacking = [row for row in table.select(["level_id", "file"]).to_pylist() if row["level_id"] not in found]
    if lacking:
        first = f"level {lacking[0]['level_id']} ({lacking[0]['file']})"
        raise UserError(
            f"{folder} lacks the files of {len(lacking):,} of the {table.num_rows} levels of {as_typed(seed)}, such as "
            f"{first}: set --levels to the folder of the files that were labelled."
        )
    with writing_to(out):
        data = seed_bytes(_groups(about, table, found), about.fragment.config, about.budget)
        files.write(out, data)
    print(
        f"{out}: {many(table.num_rows, 'level')} of {as_typed(seed)} with the levels of {folder}; {len(data):,} bytes."
    )
    print(f'Next:  levelproof.open("{out}")')


def _levels_below(folder: Path, size: str) -> dict[int, list[FoundLevel]]:
    """Map level ids to all level files of this size that contain the level, in path order."""
    found: dict[int, list[FoundLevel]] = {}
    for path in level_file_paths(folder.expanduser().absolute()):
        try:
            level = read_level_file(path).level
        except LevelFileError:  # perhaps another program's file; only missing levels are errors
            continue
        if name_of(level.size) == size and can_be_noted(str(path)):
            content_hash = content_hashes(level)[0]
            found.setdefault(level_id_for(content_hash), []).append(FoundLevel(content_hash, str(path), level))
    return found


def _groups(
    about: SeedFile, table: pa.Table, found: Mapping[int, list[FoundLevel]]
) -> Iterator[tuple[pa.Table, list[str]]]:
    """Yield row groups with content, and the content hashes of their levels."""
    for number, first in enumerate(range(0, table.num_rows, ROW_GROUP)):
        rows = table.slice(first, ROW_GROUP)
        levels = [one for at in range(0, rows.num_rows, CHUNK) for one in _played(about, rows.slice(at, CHUNK), found)]
        hashes = [one.content_hash for one in levels]
        if content_digest(hashes) != about.content[number]:
            raise Failure(
                f"The levels in these files differ from those that {about.fragment.path} was written from, although "
                "their ids match: use the files that were labelled."
            )
        columns = {name: rows.column(name) for name in SCHEMA.names}
        columns["content"] = pa.array([pack_worlds(one.level)[0] for one in levels], pa.binary())
        columns["file"] = pa.array([one.file for one in levels], pa.string())
        yield pa.table(columns, schema=SCHEMA), hashes


def _played(about: SeedFile, rows: pa.Table, found: Mapping[int, list[FoundLevel]]) -> list[FoundLevel]:
    """Choose a level file for each row. If several contain its level, perhaps with bodies in another order, take the
    first that its witness solves.

    Raises:
        Failure: there is none, or the seed file is damaged.
    """
    files = [found[level_id] for level_id in rows.column("level_id").to_pylist()]
    chosen = [each[0] for each in files]
    same_engine = about.fragment.config.get("engine_version") == ENGINE_VERSION
    left = np.flatnonzero(rows.column("witness").is_valid().to_numpy()) if same_engine else np.zeros(0, int)
    for attempt in count():
        for i in left:
            if attempt == len(files[i]):
                raise Failure(
                    f"The witness of level {rows['level_id'][i]} does not solve {chosen[i].file}, though that file has "
                    "the same level, perhaps with its bodies in another order: use the files that were labelled."
                )
            chosen[i] = files[i][attempt]
        if not len(left):
            return chosen
        left = left[~_solves(about, rows.take(left), [chosen[i].level for i in left])]
    raise AssertionError("unreachable")


def _solves(about: SeedFile, rows: pa.Table, levels: list[Level]) -> np.ndarray:
    """Whether each row's witness, played in its level, reproduces the row's checksum and reaches the goal."""
    steps = rows.column("steps_to_goal").to_numpy()
    try:
        action = unpack_witnesses(rows.column("witness").to_pylist(), steps)
    except ValueError as error:
        raise damaged_seed(about.fragment.path, error) from error
    rules = LevelSource.of(about.fragment.config, about.fragment.path).rules
    played = play_episodes(concatenate_levels(levels), action, steps, rules, frozenset())
    return played.reaches & (played.checksum == rows.column("checksum").to_numpy())
