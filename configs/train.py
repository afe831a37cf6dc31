"""The settings of `levelproof train`."""

from dataclasses import dataclass, field
from typing import Literal

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.generalist.config import EvolveConfig, LearnabilityConfig, PPOConfig, ReplayConfig
from levelproof.experts.networks.over_levels import NetworkConfig
from levelproof.physics.bounds import require

CURRICULA = ("uniform", "learnability", "replay", "evolve")  # curricula over random levels
# group of settings: the curricula that read it
READ_BY = {"curriculum": ("learnability",), "replay": ("replay", "evolve"), "evolve": ("evolve",)}


@dataclass(frozen=True)
class TrainConfig:
    """What to train on, and how."""

    levels: str = "uniform"  # uniform, learnability, replay or evolve: random levels; else a split, or level files
    size: str = "s"  # size of random levels
    distribution: str = "kinetix"  # preset of random levels
    where: str = "label NOT IN ('trivial', 'unsolvable')"  # SQL condition that selects levels of a split
    choice: Literal["uniform", "learnability", "replay"] = "uniform"  # how levels of a split or of files are chosen
    starts: int = 1  # start states per level of a split: its initial state, and others evenly spaced along its witness
    start: str = ""  # folder of a policy to continue training, with its network; empty: from scratch
    cores: int = 0  # CPU cores; 0: as many as divide lanes and minibatches evenly; a resumed run keeps its number
    interval: int = 25  # updates between lines of metrics, each with a checkpoint
    seed: int = 0  # seed of the initial weights and of all random draws
    log: Literal["none", "tensorboard", "wandb"] = "none"  # logger of scalars, besides metrics.jsonl
    network: NetworkConfig = field(default_factory=NetworkConfig)  # network of a policy from scratch
    ppo: PPOConfig = field(default_factory=PPOConfig)  # training of the policy
    curriculum: LearnabilityConfig = field(default_factory=LearnabilityConfig)  # choice of levels by learnability
    replay: ReplayConfig = field(default_factory=ReplayConfig)  # choice of levels by replay, and by evolve
    evolve: EvolveConfig = field(default_factory=EvolveConfig)  # new levels with levels=evolve

    @property
    def chosen_by(self) -> str:
        """Name of the curriculum that chooses among random levels, or among those of a split or of files."""
        return self.levels if self.levels in CURRICULA else self.choice

    def __post_init__(self) -> None:
        require(self, ("interval",), 1)
        require(self, ("starts",), 1, RECORD_STEPS)
        require(self, ("cores",), 0, 1024)
        require(self, ("seed",), 0, 2**31 - 1)
        if not self.levels:
            raise ValueError(f"levels is empty: choose one of {', '.join(CURRICULA)}, a split or level files")
        room = self.replay.capacity - self.replay.enough
        if self.levels == "evolve" and self.evolve.children > room:
            raise ValueError(
                f"evolve.children is {self.evolve.children}: it must not exceed {room}, the slots of replay.capacity = "
                f"{self.replay.capacity} that are free when replay starts"
            )
