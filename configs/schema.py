"""A job's configuration, typed and frozen, and the hash of the settings that decide its results."""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from levelproof.configs.convert import flat, nested, plain, typed
from levelproof.configs.errors import ConfigError
from levelproof.configs.numbers import parse_count, parse_duration
from levelproof.experts.config import ExpertConfig, StopConfig, check_budget
from levelproof.experts.procedure import Procedure
from levelproof.experts.search.config import SearchConfig
from levelproof.levelgen.identity.keys import MAX_LEVEL_ID, SAMPLER_VERSION
from levelproof.levelgen.level import SIZES, size_of
from levelproof.levelgen.sampling.block import control_weights
from levelproof.levelgen.sampling.distribution import CONTROL_WEIGHTS, Distribution
from levelproof.levelgen.sampling.sampler import check_size
from levelproof.levelgen.task.rules import TaskParams
from levelproof.physics.step import ENGINE_VERSION

HASH_DIGITS = 16
Density = Literal["full", "resume", "witness"]  # part of a record that is stored
Executor = Literal["auto", "ray", "inline"]
KEY_EVERY = 32  # default env steps between key frames
KEYS_EVERY = tuple(2**i for i in range(1, 9))  # allowed values: each divides a record's 256 steps
MAX_FRAME_SKIP = 64  # for densities whose readers re-simulate records
MAX_BODIES = 48  # the largest number that was tested; compiling takes minutes at that size
# (maximum bodies, levels of an untimed work unit): units take about equally long, and their levels are multiples of the
# number of experts that train side by side
UNITS = ((SIZES["s"].bodies, 32), (SIZES["m"].bodies, 16), (SIZES["l"].bodies, 8), (MAX_BODIES, 4))
GROWN_UNIT = 8  # size of a unit that grows records from seeds, as a multiple of a unit that trains

# Settings of path, amount and machine: they change neither a level nor its expert, so a split may mix their values
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
# Values of `distribution` in the hashed settings of jobs whose levels are not sampled
FROM_FILES, FROM_RECORDS = "files", "import"
# In the hashed settings of seed files and of splits grown from them: each record repeats its first episode
REPEATED: Mapping[str, str] = {"witness": "repeated"}
# Settings that decide the results of an import
OF_RECORDS = ("size", "budget", "task", "sampler_version", "engine_version")


@dataclass(frozen=True)
class JobConfig:
    """The settings of a job of `levelproof generate`."""

    size: str = "s"  # s, m, l, or counts of polygons (4 are scenery), circles, joints, thrusters, as in 8-8-8-4
    levels: str = "64"  # number of levels, with consecutive ids
    first_level: int = 0  # id of the first level
    level_files: str = ""  # a level file, or a folder of them, to label instead of random levels; empty: random levels
    budget: str = "128k"  # env steps an expert may use; also names the folder
    out: str = "data"  # folder or object store's URL; the split is written to {out}/{budget}/{size}
    unit: int | None = None  # levels per work unit (redone if its worker dies); null: enough for 20 to 60 s of work
    executor: Executor = "auto"  # ray: one worker per core or GPU; inline: this process; auto: inline if levels are few
    device: Literal["cpu", "gpu"] = "cpu"  # cpu: each worker has a core; gpu: a GPU, if one is free and JAX can use it
    workers: int = 0  # maximum number of workers; 0: one per core that memory allows, or with device=gpu one per GPU
    checkpoint: str = ""  # interval for saving unfinished experts to resume, such as 10min; empty: never
    keep_experts: bool = False  # store experts in the split, so that a larger budget can resume them
    density: Density = "full"  # stored part of a record: full (all), resume (states), witness (actions, key frames)
    key_every: int = KEY_EVERY  # env steps between key frames, for density=witness: a power of 2 from 2 to 256
    continue_from: str = ""  # a split made with keep_experts=true, whose experts are resumed; empty: none
    log: Literal["none", "tensorboard", "wandb"] = "none"  # log a run's scalars to TensorBoard or Weights & Biases
    distribution: Distribution = field(default_factory=Distribution)  # distribution of random levels
    task: TaskParams = field(default_factory=TaskParams)  # rules of the task
    search: SearchConfig = field(default_factory=SearchConfig)  # search before training
    expert: ExpertConfig = field(default_factory=ExpertConfig)  # training of experts
    stop: StopConfig = field(default_factory=StopConfig)  # when a level leaves its slot

    def __post_init__(self) -> None:
        self._check_size()
        last = self.first_level + parse_count(self.levels, "levels") - 1
        if self.first_level < 0 or last > MAX_LEVEL_ID:
            raise ConfigError(
                f"first_level and levels give ids {self.first_level} to {last}: keep them between 0 and {MAX_LEVEL_ID}."
            )
        self._check_budget()
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
            raise ConfigError(f"size is {self.size}: a level has at most {MAX_BODIES} polygons and circles.")
        if not self.level_files and not control_weights(size, self.distribution):
            raise ConfigError(
                f"size is {self.size}: it has no room for the actuators that {', '.join(CONTROL_WEIGHTS)} in "
                "distribution require (a motor needs a joint and a third body beside the scenery)."
            )

    def _check_budget(self) -> None:
        check_budget(self.env_steps, self.expert, self.stop)

    @property
    def levels_per_unit(self) -> int:
        """Number of levels in a work unit; if units are sized by duration, only until the first one ends."""
        if self.unit is not None:
            return self.unit
        bodies = size_of(self.size).bodies
        return next(levels for most, levels in UNITS if bodies <= most)

    @property
    def checkpoint_seconds(self) -> float:
        """Interval for saving unfinished experts, s; infinite: they are not saved."""
        return parse_duration(self.checkpoint, "checkpoint") if self.checkpoint else math.inf

    @property
    def level_ids(self) -> range:
        return range(self.first_level, self.first_level + parse_count(self.levels, "levels"))

    @property
    def procedure(self) -> Procedure:
        """The settings of how levels are labelled."""
        return Procedure(self.search, self.expert, self.stop)

    @property
    def stored(self) -> str:
        """Settings NAME=VALUE of the density of the records."""
        return stored_as(self.density, self.key_every)

    @property
    def origin(self) -> str:
        """Origin of the levels, for progress reports."""
        return f"budget {self.budget}"

    @property
    def env_steps(self) -> int:
        """The budget as a number."""
        return parse_count(self.budget, "budget")

    @property
    def results(self) -> dict[str, Any]:
        """All settings that decide a level's results, as JSON's types."""
        settings = flat({f.name: plain(getattr(self, f.name)) for f in fields(self)})
        kept = nested({name: value for name, value in settings.items() if name not in WITHOUT_EFFECT})
        if self.level_files:
            kept["distribution"] = FROM_FILES
        made = {"sampler_version": SAMPLER_VERSION, "engine_version": ENGINE_VERSION}
        return kept | {"budget": self.env_steps} | made

    @property
    def hash(self) -> str:
        """Short hash of `results`; a split has a single hash."""
        return hash_of(self.results)


def stored_as(density: Density, key_every: int = KEY_EVERY) -> str:
    """Write a density as settings are typed."""
    return f"density={density}" + (f" key_every={key_every}" if density == "witness" else "")


@dataclass(frozen=True)
class ImportConfig(JobConfig):
    """The settings of a job of `levelproof import`: `level_files` is a folder of records, whose actions label them."""

    def _check_budget(self) -> None:
        _ = self.env_steps  # no expert uses it here

    @property
    def results(self) -> dict[str, Any]:
        known = super().results
        return {name: known[name] for name in OF_RECORDS} | {"distribution": FROM_RECORDS}


@dataclass(frozen=True)
class GrowConfig(JobConfig):
    """The settings of a job of `levelproof grow`: `level_files` is a seed file, or a folder of seed files."""

    grown: str = "{}"  # the `results` of the seed files, as JSON

    def _check_budget(self) -> None:
        _ = self.env_steps  # no expert uses it here

    @property
    def origin(self) -> str:
        return f"grown from {self.level_files}"

    @property
    def levels_per_unit(self) -> int:
        """Number of levels in a work unit: more than in units that train, because a record grows in milliseconds."""
        return GROWN_UNIT * super().levels_per_unit

    @property
    def results(self) -> dict[str, Any]:
        return json.loads(self.grown)


def from_files(results: Mapping[str, Any]) -> bool:
    """Whether a job with these `JobConfig.results` has levels that are not sampled: level files, or imported ones."""
    return results.get("distribution") in (FROM_FILES, FROM_RECORDS)


def other_sampler(results: Mapping[str, Any]) -> str:
    """Say which sampler made the levels of a job with these `JobConfig.results`, as a verb phrase; empty: this one.

    Levels of files have the same bits in every version.
    """
    version = results.get("sampler_version")
    if version == SAMPLER_VERSION or from_files(results):
        return ""
    return f"has levels from sampler version {version!r:.9}, but this levelproof has version {SAMPLER_VERSION}"


def distribution_in(results: Mapping[str, Any]) -> Distribution | None:
    """Return the distribution that a job with these `JobConfig.results` samples; None: its levels come from files.

    Raises: as `rules_in`.
    """
    return None if from_files(results) else typed(Distribution, results["distribution"], "distribution")


def rules_in(results: Mapping[str, Any]) -> TaskParams:
    """Return the task's rules of a job with these `JobConfig.results`.

    Raises:
        ConfigError, ValueError: a setting is unknown, or has a wrong value.
        KeyError: they are missing.
    """
    return typed(TaskParams, results["task"], "task")


def is_grown(results: Mapping[str, Any]) -> bool:
    """Whether these are the settings of a seed file, or of a split grown from one."""
    return REPEATED.items() <= results.items()


def hash_of(results: dict[str, Any]) -> str:
    """Return the SHA-256 of canonical JSON, shortened to HASH_DIGITS hexadecimal digits."""
    text = json.dumps(results, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:HASH_DIGITS]
