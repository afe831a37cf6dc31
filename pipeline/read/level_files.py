"""Level files as a job's levels: which there are below a folder, and each level again where it is needed."""

import socket
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import jax
import numpy as np

from levelproof.configs.convert import flat, plain
from levelproof.configs.schema import JobConfig
from levelproof.levelgen.files.level_file import LevelFile, LevelFileError, read_level_file
from levelproof.levelgen.identity.content import content_hashes, level_id_for
from levelproof.levelgen.level import Level, name_of, size_of
from levelproof.levelgen.task.rules import DEFAULT_RULES
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.read.kinetix.folder import open_folder, read_trajectories
from levelproof.pipeline.read.kinetix.zarr2 import FormatError
from levelproof.pipeline.read.rows import read_row
from levelproof.pipeline.store.contents import level_fields
from levelproof.pipeline.store.fields import tree_of
from levelproof.pipeline.store.origins import Origin, can_be_noted, place_of


class LevelUnseen(Failure):
    """A process does not find a level where it was."""


@dataclass(frozen=True)
class Listing:
    """What there is below a folder."""

    levels: dict[str, dict[int, Origin]] = field(default_factory=dict)  # by size and id, in the order of paths
    copies: list[str] = field(default_factory=list)  # sentences on files whose level another one has, too
    refused: list[str] = field(default_factory=list)  # sentences on files that cannot be used


def levels_below(folder: Path, job: JobConfig) -> Listing:
    """The levels of all files below a folder, or of one file, that can be played by the job's rules.

    Raises:
        UserError: there is no such folder, or no file in it.
    """
    one = folder.is_file() or place_of(str(folder.absolute()))
    paths = [folder] if one else sorted(folder.rglob("*.json"))
    if not paths:
        what = "There is no level file in" if folder.is_dir() else "There is no folder of level files at"
        raise UserError(f"{what} {folder}: name a folder that has some, or a level file, with level_files=PATH.")
    found = Listing()
    for path in paths:
        try:
            origin = _usable(path.absolute(), job)
        except LevelFileError as error:
            found.refused.append(str(error))
            continue
        of_size = found.levels.setdefault(origin.size, {})
        first = of_size.setdefault(level_id_for(origin.content_hash), origin)
        if first.content_hash != origin.content_hash:
            found.refused.append(
                f"Cannot use the level file {path}: its level has by chance the id of the one in {first.file}, "
                "so label it elsewhere, with out=NAME."
            )
        elif first is not origin:
            found.copies.append(f"{path} has the same level as {first.file}, which stands for both.")
    return found


def _usable(path: Path, job: JobConfig) -> Origin:
    """Raises LevelFileError where a file has no level, or one that the job cannot have."""
    if not can_be_noted(str(path)):
        raise LevelFileError(f"Cannot use the level file {path}: no terminal shows its name, so give it another one.")
    file = _level_in(path)
    size = name_of(file.level.size)
    try:
        replace(job, size=size)
    except ValueError as error:
        raise LevelFileError(f"Cannot use the level file {path}: {error!s:.300}") from None
    if other := _other_rules(file, job):
        raise LevelFileError(
            f"Cannot use the level file {path}: it is played by other rules, so say {' '.join(other)}, "
            "and label it apart from files with other ones."
        )
    return Origin(content_hashes(file.level)[0], str(path), size)


def _level_in(path: Path) -> LevelFile:
    """Of a level file, or of a record.

    Raises:
        LevelFileError: there is no level, or one that cannot be used.
    """
    if (place := place_of(str(path))) is None:
        return read_level_file(path)
    try:
        folder = open_folder(place.folder)
        found = read_trajectories(folder.named(place.array), place.row, place.row + 1)
    except FormatError as error:
        raise LevelFileError(f"Cannot use the level of {path}: {error}.") from None
    if found.wrong[0]:
        raise LevelFileError(f"Cannot use the level of {path}: {found.wrong[0]}.")
    return LevelFile(found.level, DEFAULT_RULES)


def _other_rules(file: LevelFile, job: JobConfig) -> list[str]:
    """The settings that would make the job's rules those of a file; of one of them no file says anything."""
    padding = job.task.physics.faithful_padding
    theirs = replace(file.rules, physics=replace(file.rules.physics, faithful_padding=padding))
    ours = flat(plain(job.task))
    return [f"task.{name}={value}" for name, value in flat(plain(theirs)).items() if value != ours[name]]


def levels_at(origins: Sequence[Origin]) -> Level:
    """Side by side; raises as `level_at`."""
    return jax.tree.map(lambda *lanes: np.concatenate(lanes, -1), *map(level_at, origins))


def level_at(origin: Origin) -> Level:
    """A level again, one lane.

    Raises:
        LevelUnseen: its file is not here, or has another level now.
        Failure: its shard is damaged.
    """
    if origin.shard:
        names = [field.name for field in level_fields(size_of(origin.size))]
        return tree_of(Level, read_row(Path(origin.split), origin._asdict(), names), "level/")
    try:
        level = _level_in(Path(origin.file)).level
    except LevelFileError as error:
        raise LevelUnseen(
            f"{str(error)[:-1]} on {socket.gethostname()}: put it back, into a folder that all machines share."
        ) from None
    if content_hashes(level) != [origin.content_hash] or name_of(level.size) != origin.size:
        raise LevelUnseen(f"The level file {origin.file} has another level than it had: put the one that it had back.")
    return level
