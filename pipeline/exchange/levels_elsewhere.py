"""Seed files without their levels: they are added again from a folder of level files."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import pyarrow as pa

from levelproof.configs.schema import from_files
from levelproof.levelgen.files.level_file import LevelFileError, read_level_file
from levelproof.levelgen.identity.content import content_hashes, level_id_for
from levelproof.levelgen.level import Level, name_of
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.exchange.seed import check_new_seed
from levelproof.pipeline.read.levels import writing_to
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store import files
from levelproof.pipeline.store.remote import as_typed
from levelproof.pipeline.store.seed.columns import ROW_GROUP, SCHEMA
from levelproof.pipeline.store.seed.file import SeedFile, read_seed, seed_files
from levelproof.pipeline.store.seed.worlds import pack_worlds
from levelproof.pipeline.store.seed.write import content_digest, seed_bytes
from levelproof.pipeline.words import many


def add_levels(seed: Path, folder: Path, out: Path) -> None:
    """Write a seed file that lacks its levels to a new one that contains them; print a summary.

    Args:
        seed: a seed file that was exported without its levels.
        folder: level files anywhere below it; files of other levels are ignored.
        out: the new file.

    Raises:
        UserError: `seed` is not one seed file, its levels come from their ids, or the folder lacks one of
            them, or `out` exists or is not named as seed files are.
        Failure: the seed file is damaged, or its levels are not those that it was written from.
    """
    check_new_seed(out)
    paths = seed_files(seed)
    if len(paths) != 1:
        raise UserError(f"{as_typed(seed)} is not one seed file: --levels completes one file at a time.")
    about, table = read_seed(paths[0], SCHEMA.names)
    if not from_files(about.fragment.config):
        raise UserError(f"The levels of {as_typed(seed)} are sampled from their ids: leave out --levels.")
    prepare_jax()
    found = _levels_below(folder, str(about.fragment.config["size"]))
    lacking = [row for row in table.select(["level_id", "file"]).to_pylist() if row["level_id"] not in found]
    if lacking:
        first = f"level {lacking[0]['level_id']} ({lacking[0]['file']})"
        raise UserError(
            f"{folder} has no file of {many(len(lacking), 'level')} of the {table.num_rows} of {as_typed(seed)}, "
            f"{first} among them: set --levels to the folder of the files that were labelled."
        )
    with writing_to(out):
        data = seed_bytes(_groups(about, table, found), about.fragment.config, about.budget)
        files.write(out, data)
    print(
        f"{out}: {many(table.num_rows, 'level')} of {as_typed(seed)} with the levels of {folder}; {len(data):,} bytes."
    )
    print(f'Next:  levelproof.open("{out}")')


def _levels_below(folder: Path, size: str) -> dict[int, tuple[str, Level]]:
    """Return the content hash and the level of every level file of a size, by the level's id."""
    found = {}
    for path in sorted(folder.rglob("*.json")):
        try:
            level = read_level_file(path).level
        except LevelFileError:  # of another program, perhaps: what counts is whether a level is lacking in the end
            continue
        if name_of(level.size) == size:
            content_hash = content_hashes(level)[0]
            found[level_id_for(content_hash)] = content_hash, level
    return found


def _groups(
    about: SeedFile, table: pa.Table, found: Mapping[int, tuple[str, Level]]
) -> Iterator[tuple[pa.Table, list[str]]]:
    """Yield row groups with content, and the content hashes of their levels."""
    for number, first in enumerate(range(0, table.num_rows, ROW_GROUP)):
        rows = table.slice(first, ROW_GROUP)
        levels = [found[level_id] for level_id in rows.column("level_id").to_pylist()]
        hashes = [content_hash for content_hash, _ in levels]
        if content_digest(hashes) != about.content[number]:
            raise Failure(
                f"The level files have other levels than {about.fragment.path} was written from, though with the same "
                "ids: use the files that were labelled."
            )
        content = pa.array([pack_worlds(level)[0] for _, level in levels], pa.binary())
        yield rows.set_column(rows.schema.get_field_index("content"), "content", content).select(SCHEMA.names), hashes
