"""Random 2D physics levels, experts that provably solve them, and the data of it: all that users import.

Re-exports and nothing else: each name says here where it lives and is imported when it is first used, so that
`import levelproof` and `levelproof --help` do not wait for JAX.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from experts.witness import Record as Record
    from experts.witness import replay as replay
    from levelgen.files.level_file import LevelFile as LevelFile
    from levelgen.files.level_file import read_level_file as read_level_file
    from levelgen.files.level_file import write_level_file as write_level_file
    from levelgen.level import SIZES as SIZES
    from levelgen.level import Level as Level
    from levelgen.pictures.raster import draw as draw
    from levelgen.sampling.distribution import Distribution as Distribution
    from levelgen.sampling.sampler import sample_levels as sample_levels
    from levelgen.task.environment import make as make
    from levelgen.task.environment import starts as starts
    from levelgen.task.rules import TaskParams as TaskParams
    from physics.types import Size as Size
    from pipeline.read.columns import levels_from as levels_from
    from pipeline.read.dataset.batch import Batch as Batch
    from pipeline.read.dataset.dataset import Dataset as Dataset
    from pipeline.read.dataset.dataset import open as open
    from pipeline.store.manifest import read_manifest as read_manifest
    from pipeline.store.shard import EngineDiffers as EngineDiffers
    from pipeline.store.shard import Shard as Shard
    from pipeline.version import __version__ as __version__

HOME = {
    "Batch": "pipeline.read.dataset.batch",
    "Dataset": "pipeline.read.dataset.dataset",
    "SIZES": "levelgen.level",
    "EngineDiffers": "pipeline.store.shard",
    "Distribution": "levelgen.sampling.distribution",
    "Level": "levelgen.level",
    "LevelFile": "levelgen.files.level_file",
    "Record": "experts.witness",
    "Shard": "pipeline.store.shard",
    "Size": "physics.types",
    "TaskParams": "levelgen.task.rules",
    "__version__": "pipeline.version",
    "draw": "levelgen.pictures.raster",
    "levels_from": "pipeline.read.columns",
    "make": "levelgen.task.environment",
    "open": "pipeline.read.dataset.dataset",
    "read_level_file": "levelgen.files.level_file",
    "read_manifest": "pipeline.store.manifest",
    "replay": "experts.witness",
    "sample_levels": "levelgen.sampling.sampler",
    "starts": "levelgen.task.environment",
    "write_level_file": "levelgen.files.level_file",
}
__all__ = list(HOME)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(HOME[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
