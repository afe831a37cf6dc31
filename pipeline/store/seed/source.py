"""Levels of a seed file: sampled from their ids, or unpacked from their content."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from levelproof.configs.errors import ConfigError
from levelproof.configs.schema import MAX_FRAME_SKIP, distribution_in, other_sampler, rules_in
from levelproof.levelgen.batching import block_size, by_blocks
from levelproof.levelgen.level import Level, size_of
from levelproof.levelgen.sampling.distribution import Distribution
from levelproof.levelgen.sampling.sampler import CHUNK, check_size, on_cpu, sample_chunk
from levelproof.levelgen.task.rules import TaskParams
from levelproof.physics.types import Size
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.store.seed.file import damaged_seed
from levelproof.pipeline.store.seed.worlds import unpack_worlds
from levelproof.pipeline.urls import as_typed, quoted


@dataclass(frozen=True)
class LevelSource:
    """What makes the levels of a seed file from its rows, and the rules by which they are played."""

    path: Path
    size: Size
    distribution: Distribution | None  # None: each row has its level's content
    rules: TaskParams

    @staticmethod
    def of(config: Mapping[str, Any], path: Path) -> "LevelSource":
        """Return the source that a seed file's configuration describes.

        Raises:
            Failure: this program makes other levels from their ids, or does not accept the settings.
        """
        try:
            return LevelSource._made(config, path)
        except ConfigError as error:
            raise Failure(f"The seed file {path} {error}: use the levelproof that wrote it.") from None

    @staticmethod
    def require_readable(config: Mapping[str, Any], split: Path) -> None:
        """Refuse the settings of a split whose seed file this program could not read.

        Raises:
            UserError: it makes other levels from their ids, or does not accept the settings in seed files.
        """
        try:
            LevelSource._made(config, split)
        except ConfigError as error:
            raise UserError(
                f"Cannot write a seed file of {as_typed(split)}, because it {error}: export it to another format, "
                "or with the levelproof that made it."
            ) from None

    @staticmethod
    def _made(config: Mapping[str, Any], path: Path) -> "LevelSource":
        """Return the source. Raise ConfigError, with what the configuration has, if this program has no such source."""
        try:
            rules = rules_in(config)
            size = size_of(config["size"])
            check_size(size)
            distribution = distribution_in(config)
            if rules.frame_skip > MAX_FRAME_SKIP:
                raise ConfigError(
                    f"task.frame_skip is {rules.frame_skip}, and seed files have at most {MAX_FRAME_SKIP}"
                )
            if not isinstance(config["engine_version"], int):
                raise ConfigError("engine_version is not a number")
        except (ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"has settings that this levelproof does not accept ({error})") from None
        if differs := other_sampler(config):
            raise ConfigError(differs)
        return LevelSource(path, size, distribution, rules)

    def levels(self, level_ids: Int[np.ndarray, " level"], content: Sequence[bytes | None]) -> Level:
        """Make levels: numpy arrays, level axis last.

        Args:
            level_ids: their ids, one or more.
            content: packed levels, if there is no distribution.

        Raises:
            UserError: the file was written without its levels.
            Failure: a content is invalid.
        """
        if self.distribution is None:
            if any(one is None for one in content):
                raise without_levels(self.path)
            try:
                return unpack_worlds([one for one in content if one is not None], self.size)
            except ValueError as error:
                raise damaged_seed(self.path, error) from error
        ids = np.asarray(level_ids, np.int32)
        sampled = lambda some: sample_chunk(ids[some], self.size, self.distribution)
        with on_cpu():
            return by_blocks(sampled, len(ids), block_size(len(ids), CHUNK))


def without_levels(path: Path) -> UserError:
    """Return the error for a seed file that was written without its levels."""
    return UserError(
        f"The seed file {as_typed(path)} does not contain its levels: add them from their level files with "
        f"`levelproof export {quoted(path)} --format seed --levels FOLDER -o whole.parquet`."
    )
