"""A job's configuration: what to make, typed and frozen, and the hash of what decides its results."""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from levelproof.configs.convert import flat, plain
from levelproof.configs.errors import ConfigError
from levelproof.configs.numbers import parse_count, parse_duration
from levelproof.experts.config import ExpertConfig, StopConfig, check_budget
from levelproof.experts.procedure import Procedure
from levelproof.experts.search.config import SearchConfig
from levelproof.levelgen.identity.keys import MAX_LEVEL_ID, SAMPLER_VERSION
from levelproof.levelgen.level import SIZES, size_of
from levelproof.levelgen.sampling.distribution import CONTROL_WEIGHTS, Distribution
from levelproof.levelgen.sampling.sampler import check_size, control_weights
from levelproof.levelgen.task.rules import TaskParams

HASH_DIGITS = 16
Density = Literal["full", "resume", "witness"]  # how much of a record is stored
KEY_EVERY = 32  # env steps between key frames, by default
KEYS_EVERY = tuple(2**i for i in range(1, 9))  # what they may be: they divide a record
MAX_FRAME_SKIP = 64  # where records are simulated again by those who read them
MAX_BODIES = 48  # the most that was tried; compiling takes minutes from there
# Levels of an untimed work unit by the number of bodies: about as long to train, multiples of the experts side by side
UNITS = ((SIZES["s"].bodies, 32), (SIZES["m"].bodies, 16), (SIZES["l"].bodies, 8), (MAX_BODIES, 4))

# Where, how many, by whom and on what machine: these change neither a level nor its expert, so one split may mix them.
WITHOUT_EFFECT = frozenset(
    {
        "levels",
        "first_level",
        "level_files",
        "out",
        "unit",
        "executor",
        "device",
        "workers",
        "checkpoint",
        "keep_experts",
        "continue_from",
        "density",
        "key_every",
        "log",
        "expert.slots",
        "search.rounds",
    }
)
RENAMED: Mapping[str, str] = {}  # names of settings in earlier versions, with a dot: those of today
REMOVED: Mapping[str, Any] = {"scout.rounds": 0}  # settings of earlier versions: the value that matches this version
# In the results of levels that no id makes, where those of random levels have their distribution
FROM_FILES, FROM_RECORDS = "files", "import"
OF_RECORDS = ("size", "budget", "task", "sampler_version")  # what decides results where nobody searches or trains


@dataclass(frozen=True)
class JobConfig:
    """What `levelproof generate` makes."""

    size: str = "s"  # s, m, l, or how many polygons (4 are scenery), circles, joints, thrusters, as in 8-8-8-4
    levels: str = "64"  # how many, with consecutive ids
    first_level: int = 0  # id of the first of them
    level_files: str = ""  # a level file, or a folder of them, to label instead of random levels; empty: random levels
    budget: str = "128k"  # environment steps an expert may use; names the folder
    out: str = "data"  # folder, or URL of an object store; the split is written to {out}/{budget}/{size}
    unit: int | None = None  # levels per work unit, lost when its worker dies; null: 20 to 60 s of a worker, as timed
    executor: Literal["ray", "inline"] = "ray"  # ray: a worker per core or GPU; inline: this process, for debugging
    device: Literal["cpu", "gpu"] = "cpu"  # a core, or a GPU, for each worker; gpu: if one is free and JAX can use it
    workers: int = 0  # maximum number; 0: one per core that memory allows, or with device=gpu one per GPU
    checkpoint: str = ""  # how often experts under way are kept, as in 10min, to go on with; empty: never
    keep_experts: bool = False  # keep experts, too, so that a larger budget can go on with them
    density: Density = "full"  # what is stored of a record: full (all), resume (states), witness (actions, key frames)
    key_every: int = KEY_EVERY  # env steps of an episode between key frames of density=witness: a power of 2 up to 256
    continue_from: str = ""  # a split made with keep_experts=true, whose experts go on; empty: none
    log: Literal["none", "tensorboard", "wandb"] = "none"  # scalars of a run, for TensorBoard or Weights & Biases
    distribution: Distribution = field(default_factory=Distribution)  # what random levels are like
    task: TaskParams = field(default_factory=TaskParams)  # what a level asks for
    search: SearchConfig = field(default_factory=SearchConfig)  # the search before an expert trains
    expert: ExpertConfig = field(default_factory=ExpertConfig)  # who solves it
    stop: StopConfig = field(default_factory=StopConfig)  # when a level leaves its slot

    def __post_init__(self) -> None:
        self._check_size()
        last = self.first_level + parse_count(self.levels, "levels") - 1
        if self.first_level < 0 or last > MAX_LEVEL_ID:
            raise ConfigError(f"level ids {self.first_level} to {last} do not fit: they run from 0 to {MAX_LEVEL_ID}.")
        check_budget(self.env_steps, self.expert, self.stop)
        if self.unit is not None and self.unit < 1:
            raise ConfigError(f"unit is {self.unit}: a work unit needs at least 1 level.")
        if self.workers < 0:
            raise ConfigError(f"workers is {self.workers}: use 0 for one per core or GPU, or a number from 1.")
        _ = self.checkpoint_seconds
        if self.key_every not in KEYS_EVERY:
            raise ConfigError(f"key_every is {self.key_every}: choose one of {', '.join(map(str, KEYS_EVERY))}.")
        if self.density != "full" and self.task.frame_skip > MAX_FRAME_SKIP:
            raise ConfigError(f"task.frame_skip is {self.task.frame_skip}: above {MAX_FRAME_SKIP}, use density=full.")
        if not self.out:
            raise ConfigError("out is empty: name a folder, as in out=data.")

    def _check_size(self) -> None:
        size = size_of(self.size)
        check_size(size)
        if size.bodies > MAX_BODIES:
            raise ConfigError(f"size is {self.size}: experts train among at most {MAX_BODIES} polygons and circles.")
        if not self.level_files and not control_weights(size, self.distribution):
            raise ConfigError(
                f"size is {self.size}: it has no room for what must act, of which {', '.join(CONTROL_WEIGHTS)} in "
                "distribution are the weights (a motor needs a joint and a third body beside the scenery)."
            )

    @property
    def levels_per_unit(self) -> int:
        """Levels of a work unit; if `unit` is null, while nobody knows what a level takes."""
        if self.unit is not None:
            return self.unit
        bodies = size_of(self.size).bodies
        return next(levels for most, levels in UNITS if bodies <= most)

    @property
    def checkpoint_seconds(self) -> float:
        """Infinite: experts under way are not kept."""
        return parse_duration(self.checkpoint, "checkpoint") if self.checkpoint else math.inf

    @property
    def level_ids(self) -> range:
        return range(self.first_level, self.first_level + parse_count(self.levels, "levels"))

    @property
    def procedure(self) -> Procedure:
        """How its levels get their labels."""
        return Procedure(self.search, self.expert, self.stop)

    @property
    def stored(self) -> str:
        """How its records are stored."""
        return stored_as(self.density, self.key_every)

    @property
    def env_steps(self) -> int:
        """The budget as a number."""
        return parse_count(self.budget, "budget")

    @property
    def results(self) -> dict[str, Any]:
        """Everything that decides a level's results, as JSON's types."""
        kept = decisive({f.name: plain(getattr(self, f.name)) for f in fields(self)})
        if self.level_files:
            kept["distribution"] = FROM_FILES
        return kept | {"budget": self.env_steps, "sampler_version": SAMPLER_VERSION}

    @property
    def hash(self) -> str:
        """Short hash of `results`: other hash, other split."""
        return hash_of(self.results)


def stored_as(density: Density, key_every: int = KEY_EVERY) -> str:
    """A density in the words of settings."""
    return f"density={density}" + (f" key_every={key_every}" if density == "witness" else "")


@dataclass(frozen=True)
class ImportConfig(JobConfig):
    """What `levelproof import` makes: levels, the folder `level_files` of records, are labelled by actions it has."""

    @property
    def results(self) -> dict[str, Any]:
        known = super().results
        return {name: known[name] for name in OF_RECORDS} | {"distribution": FROM_RECORDS}


def from_files(results: Mapping[str, Any]) -> bool:
    """Whether a job with these `JobConfig.results` labels levels that no id makes: level files, or imported ones."""
    return results.get("distribution") in (FROM_FILES, FROM_RECORDS)


def decisive(settings: Mapping[str, Any], renamed: Mapping[str, str] = RENAMED) -> dict[str, Any]:
    """Keep the settings that decide results, under today's names, whichever version wrote them down.

    Splits record the `JobConfig.results` of the version that made them. Readers compare what this returns of them, so
    a setting that loses its effect, takes another name or is removed leaves a split the same. A removed setting with a
    value that this version cannot reproduce is kept, so that the configurations differ.

    Args:
        settings: nested, as JSON has them.
        renamed: today's names by earlier ones, all with dots.

    Raises:
        ValueError: a setting lies below a value.
    """
    kept: dict[str, Any] = {}
    for name, value in flat(settings).items():
        if REMOVED.get(name, ...) == value:
            continue
        if (now := renamed.get(name, name)) not in WITHOUT_EFFECT:
            *groups, last = now.split(".")
            group = kept
            for part in groups:
                group = group.setdefault(part, {})
                if not isinstance(group, dict):
                    raise ValueError(f"{now} lies below a value")
            group[last] = value
    return kept


def hash_of(results: dict[str, Any]) -> str:
    """SHA-256 over canonical JSON, shortened to HASH_DIGITS hexadecimal digits."""
    text = json.dumps(results, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:HASH_DIGITS]
