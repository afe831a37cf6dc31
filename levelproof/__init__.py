"""Random 2D physics levels, experts that provably solve them, and the resulting data: everything that users import.

This module only re-exports. It imports a name's home when the name is first used, so `import levelproof` and
`levelproof --help` do not wait for JAX. The rooms `levelproof.physics`, `.levelgen`, `.experts`, `.configs` and
`.pipeline` are links to the folders at the top of the repository; a wheel contains them as folders.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if os.name == "nt":
    raise ImportError("levelproof runs on Linux and macOS: on Windows, use it in WSL.")
if not os.path.isdir(os.path.join(__path__[0], "physics")):
    raise ImportError(
        f"{os.path.join(__path__[0], 'physics')} is not a folder, because git wrote this checkout without symbolic "
        "links: run `git config core.symlinks true` and `git checkout -- levelproof`."
    )

if TYPE_CHECKING:
    from levelproof.experts.networks.saved import Policy as Policy
    from levelproof.experts.networks.saved import PolicyError as PolicyError
    from levelproof.experts.networks.saved import load_policy as load_policy
    from levelproof.experts.networks.saved import save_policy as save_policy
    from levelproof.experts.witness.witness import Record as Record
    from levelproof.experts.witness.witness import replay as replay
    from levelproof.levelgen.files.entries import LevelFileError as LevelFileError
    from levelproof.levelgen.files.level_file import LevelFile as LevelFile
    from levelproof.levelgen.files.level_file import read_level_file as read_level_file
    from levelproof.levelgen.files.level_file import write_level_file as write_level_file
    from levelproof.levelgen.level import SIZES as SIZES
    from levelproof.levelgen.level import Level as Level
    from levelproof.levelgen.level import concatenate_levels as concatenate_levels
    from levelproof.levelgen.pictures.raster import draw as draw
    from levelproof.levelgen.sampling.distribution import Distribution as Distribution
    from levelproof.levelgen.sampling.sampler import Sampler as Sampler
    from levelproof.levelgen.sampling.sampler import sample_levels as sample_levels
    from levelproof.levelgen.sampling.sampler import sampler as sampler
    from levelproof.levelgen.task.environment import starts as starts
    from levelproof.levelgen.task.lanes import Lanes as Lanes
    from levelproof.levelgen.task.rules import TaskParams as TaskParams
    from levelproof.levelgen.task.to_gymnax import to_gymnax as to_gymnax
    from levelproof.physics.types import Size as Size
    from levelproof.pipeline.dataset.batch import Batch as Batch
    from levelproof.pipeline.dataset.dataset import Dataset as Dataset
    from levelproof.pipeline.dataset.dataset import open as open
    from levelproof.pipeline.dataset.environment import make as make
    from levelproof.pipeline.dataset.episodes import EpisodeBatch as EpisodeBatch
    from levelproof.pipeline.dataset.sample import sample_data as sample_data
    from levelproof.pipeline.errors import Failure as Failure
    from levelproof.pipeline.errors import LevelproofError as LevelproofError
    from levelproof.pipeline.errors import StoreFailure as StoreFailure
    from levelproof.pipeline.errors import UserError as UserError
    from levelproof.pipeline.exchange.tables import levels_from as levels_from
    from levelproof.pipeline.store.manifest import read_manifest as read_manifest
    from levelproof.pipeline.store.seed.packed import witness_text as witness_text
    from levelproof.pipeline.store.shard import EngineDiffers as EngineDiffers
    from levelproof.pipeline.store.shard import Shard as Shard
    from levelproof.pipeline.version import __version__ as __version__

HOME = {
    "concatenate_levels": "levelproof.levelgen.level",
    "LevelproofError": "levelproof.pipeline.errors",
    "UserError": "levelproof.pipeline.errors",
    "Failure": "levelproof.pipeline.errors",
    "StoreFailure": "levelproof.pipeline.errors",
    "LevelFileError": "levelproof.levelgen.files.entries",
    "Batch": "levelproof.pipeline.dataset.batch",
    "Dataset": "levelproof.pipeline.dataset.dataset",
    "EpisodeBatch": "levelproof.pipeline.dataset.episodes",
    "SIZES": "levelproof.levelgen.level",
    "EngineDiffers": "levelproof.pipeline.store.shard",
    "Distribution": "levelproof.levelgen.sampling.distribution",
    "Lanes": "levelproof.levelgen.task.lanes",
    "Level": "levelproof.levelgen.level",
    "LevelFile": "levelproof.levelgen.files.level_file",
    "Policy": "levelproof.experts.networks.saved",
    "PolicyError": "levelproof.experts.networks.saved",
    "Record": "levelproof.experts.witness.witness",
    "Shard": "levelproof.pipeline.store.shard",
    "Size": "levelproof.physics.types",
    "TaskParams": "levelproof.levelgen.task.rules",
    "__version__": "levelproof.pipeline.version",
    "draw": "levelproof.levelgen.pictures.raster",
    "levels_from": "levelproof.pipeline.exchange.tables",
    "load_policy": "levelproof.experts.networks.saved",
    "make": "levelproof.pipeline.dataset.environment",
    "open": "levelproof.pipeline.dataset.dataset",
    "read_level_file": "levelproof.levelgen.files.level_file",
    "read_manifest": "levelproof.pipeline.store.manifest",
    "replay": "levelproof.experts.witness.witness",
    "Sampler": "levelproof.levelgen.sampling.sampler",
    "sample_data": "levelproof.pipeline.dataset.sample",
    "sample_levels": "levelproof.levelgen.sampling.sampler",
    "sampler": "levelproof.levelgen.sampling.sampler",
    "save_policy": "levelproof.experts.networks.saved",
    "starts": "levelproof.levelgen.task.environment",
    "to_gymnax": "levelproof.levelgen.task.to_gymnax",
    "witness_text": "levelproof.pipeline.store.seed.packed",
    "write_level_file": "levelproof.levelgen.files.level_file",
}
__all__ = list(HOME)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(HOME[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
