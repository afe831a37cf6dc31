"""Level files as a job's levels: listing those below a folder, and loading a level by its origin."""

import shlex
import socket
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from levelproof.configs.convert import flat, plain
from levelproof.configs.schema import JobConfig
from levelproof.experts.networks.saved import CONFIG, WEIGHTS
from levelproof.levelgen.files.entries import LevelFileError
from levelproof.levelgen.files.level_file import LevelFile, read_level_file
from levelproof.levelgen.identity.content import content_hashes, level_id_for
from levelproof.levelgen.level import Level, concatenate_levels, name_of, size_of
from levelproof.levelgen.task.rules import DEFAULT_RULES, TaskParams
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.read.kinetix.folder import open_folder, read_trajectories
from levelproof.pipeline.read.kinetix.zarr2 import FormatError
from levelproof.pipeline.read.rows import read_row
from levelproof.pipeline.store.contents import level_fields
from levelproof.pipeline.store.fields import tree_of
from levelproof.pipeline.store.layout import JOB, MANIFEST
from levelproof.pipeline.store.origins import Origin, can_be_noted, place_of
from levelproof.pipeline.store.seed.file import is_seed
from levelproof.pipeline.store.seed.shard import stored_levels


class LevelUnavailable(Failure):
    """A level's file is missing on this machine, or now contains another level."""


@dataclass(frozen=True)
class Listing:
    """Levels of the files below a folder."""

    levels: dict[str, dict[int, Origin]] = field(default_factory=dict)  # by size and id, in path order
    copies: list[str] = field(default_factory=list)  # one sentence per file that repeats another file's level
    refused: list[str] = field(default_factory=list)  # one sentence per unusable file


def levels_below(folder: Path, job: JobConfig) -> Listing:
    """List the levels of all files below a folder, or of one file, that the job's rules can play.

    Raises:
        UserError: the folder does not exist, or has no file.
    """
    one = folder.is_file() or place_of(str(folder.absolute()))
    paths = [folder] if one else level_file_paths(folder)
    if not paths:
        what = "There is no level file in" if folder.is_dir() else "There is no folder of level files at"
        raise UserError(f"{what} {folder}: set level_files=PATH to a folder of level files, or to one file.")
    listing = Listing()
    for path in paths:
        try:
            origin = _origin_of(path.absolute(), job)
        except LevelFileError as error:
            listing.refused.append(str(error))
            continue
        same_size = listing.levels.setdefault(origin.size, {})
        first = same_size.setdefault(level_id_for(origin.content_hash), origin)
        if first.content_hash != origin.content_hash:
            listing.refused.append(
                f"Cannot use the level file {path}: its level id collides with that of {first.file}: "
                "label it in another split, with out=NAME."
            )
        elif first is not origin:
            listing.copies.append(f"{path} has the same level as {first.file}, which represents both.")
    return listing


def level_file_paths(folder: Path) -> list[Path]:
    """Return the JSON files below a folder, in order, without those of splits and policies written there."""
    paths = sorted(folder.rglob("*.json"))
    splits = {path.parent for path in paths if path.name == JOB and (path.parent / MANIFEST).is_dir()}
    policies = {path.parent for path in paths if path.name == CONFIG and (path.parent / WEIGHTS).is_file()}
    return [path for path in paths if (splits | policies).isdisjoint(path.parents)]


def _origin_of(path: Path, job: JobConfig) -> Origin:
    """Return the origin of a file's level. Raise LevelFileError if it has none that the job can use."""
    if not can_be_noted(str(path)):
        raise LevelFileError(
            f"Cannot use the level file {path}: its name has characters that terminals cannot show, so rename it."
        )
    file = _read_level(path)
    size = name_of(file.level.size)
    try:
        replace(job, size=size)
    except ValueError as error:
        raise LevelFileError(f"Cannot use the level file {path}: {error!s:.300}") from None
    if other := _other_rules(file, job):
        settings = shlex.join([f"level_files={path}", *other])
        raise LevelFileError(
            f"Cannot use the level file {path}: its rules differ from this command's, so label it separately: run "
            f"`levelproof generate` with your other settings, {settings} and another out=."
        )
    return Origin(content_hashes(file.level)[0], str(path), size)


def _read_level(path: Path) -> LevelFile:
    """Read the level of a level file, or of a record in a folder of the reference.

    Raises:
        LevelFileError: the level is missing or unusable.
    """
    if (place := place_of(str(path))) is None:
        return read_level_file(path)
    try:
        folder = open_folder(place.folder)
        trajectories = read_trajectories(folder.array(place.array), place.row, place.row + 1)
    except FormatError as error:
        raise LevelFileError(f"Cannot use the level of {path}: {error}.") from None
    if trajectories.wrong[0]:
        raise LevelFileError(f"Cannot use the level of {path}: {trajectories.wrong[0]}.")
    return LevelFile(trajectories.level, DEFAULT_RULES)


def _other_rules(file: LevelFile, job: JobConfig) -> list[str]:
    """Return the settings, NAME=VALUE, that would give the job the file's rules.

    Ignores `faithful_padding`, which level files do not store.
    """
    padding = job.task.physics.faithful_padding
    theirs = replace(file.rules, physics=replace(file.rules.physics, faithful_padding=padding))
    return rule_settings(theirs, job.task)


def rule_settings(rules: TaskParams, others: TaskParams = DEFAULT_RULES) -> list[str]:
    """Return the settings, NAME=VALUE, in which rules differ from others."""
    known = flat(plain(others))
    return [f"task.{name}={value}" for name, value in flat(plain(rules)).items() if value != known[name]]


def levels_at(origins: Sequence[Origin]) -> Level:
    """Load several levels, level axis last. Raises as `level_at`."""
    source = origins[0].split  # of all: a unit's levels come from one place
    if source and is_seed(Path(source)):
        levels = stored_levels(Path(source), np.array([origin.level_id for origin in origins]))
        for origin, content_hash in zip(origins, content_hashes(levels), strict=True):
            if content_hash != origin.content_hash:
                raise LevelUnavailable(
                    f"The seed file {source} has changed: its level {origin.level_id} differs now, so restore the file."
                )
        return levels
    return concatenate_levels([level_at(origin) for origin in origins])


def level_at(origin: Origin) -> Level:
    """Load a level from its shard or its file; level axis last, of length 1.

    Raises:
        LevelUnavailable: its file is missing, or now contains another level.
        Failure: its shard is damaged.
    """
    if origin.shard:
        names = [field.name for field in level_fields(size_of(origin.size))]
        return tree_of(Level, read_row(Path(origin.split), origin._asdict(), names), "level/")
    try:
        level = _read_level(Path(origin.file)).level
    except LevelFileError as error:
        raise LevelUnavailable(
            f"{str(error)[:-1]} on {socket.gethostname()}: put it back, in a folder that all machines share."
        ) from None
    if content_hashes(level) != [origin.content_hash] or name_of(level.size) != origin.size:
        raise LevelUnavailable(f"The level file {origin.file} no longer contains the level that it had: restore it.")
    return level
