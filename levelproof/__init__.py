"""Random 2D physics levels, experts that provably solve them, and the data of it: all that users import.

Re-exports and nothing else: each name says here where it lives and is imported when it is first used, so that
`import levelproof` and `levelproof --help` do not wait for JAX.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from experts.witness import Record, replay
    from levelgen.files.level_file import LevelFile, read_level_file, write_level_file
    from levelgen.level import SIZES, Level
    from levelgen.pictures.raster import draw
    from levelgen.sampling.distribution import Distribution
    from levelgen.sampling.sampler import sample_levels
    from levelgen.task.environment import make, starts
    from levelgen.task.rules import TaskParams
    from physics.types import Size
    from pipeline.store.manifest import read_manifest
    from pipeline.store.shard import Shard
    from pipeline.version import __version__

__all__ = [
    "SIZES",
    "Distribution",
    "Level",
    "LevelFile",
    "Record",
    "Shard",
    "Size",
    "TaskParams",
    "__version__",
    "draw",
    "make",
    "read_level_file",
    "read_manifest",
    "replay",
    "sample_levels",
    "starts",
    "write_level_file",
]

HOME = {
    "SIZES": "levelgen.level",
    "Distribution": "levelgen.sampling.distribution",
    "Level": "levelgen.level",
    "LevelFile": "levelgen.files.level_file",
    "Record": "experts.witness",
    "Shard": "pipeline.store.shard",
    "Size": "physics.types",
    "TaskParams": "levelgen.task.rules",
    "__version__": "pipeline.version",
    "draw": "levelgen.pictures.raster",
    "make": "levelgen.task.environment",
    "read_level_file": "levelgen.files.level_file",
    "read_manifest": "pipeline.store.manifest",
    "replay": "experts.witness",
    "sample_levels": "levelgen.sampling.sampler",
    "starts": "levelgen.task.environment",
    "write_level_file": "levelgen.files.level_file",
}


def __getattr__(name: str) -> Any:
    if name not in HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(HOME[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
