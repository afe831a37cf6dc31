"""The settings of `levelproof clone`."""

from dataclasses import dataclass, field
from typing import Literal

from levelproof.experts.imitation import ImitationConfig
from levelproof.experts.networks.over_levels import NetworkConfig
from levelproof.physics.bounds import require


@dataclass(frozen=True)
class CloneConfig:
    """What to clone, and how."""

    where: str = "label = 'solved'"  # SQL condition on the manifest's columns that selects levels
    episodes: Literal["first", "all"] = "first"  # first: each record up to its first goal; all: whole records
    mirror: bool = False  # also learn from mirrored witnesses that solve their mirrored level
    validation: float = 0.1  # share of the levels that are held out for validation, chosen by content hash
    pool: int = 16_384  # levels in memory, drawn evenly; if the splits have more, the next pool is read ahead
    refresh: int = 1000  # updates until other levels replace those in memory, if the splits have more
    interval: int = 500  # updates between validations, each with a checkpoint
    played: int = 256  # validation levels of each split that the policy plays, once each, at each validation
    seed: int = 0  # seed of the initial weights and of all random draws
    log: Literal["none", "tensorboard", "wandb"] = "none"  # logger of scalars, besides metrics.jsonl
    network: NetworkConfig = field(default_factory=NetworkConfig)  # network of the policy
    train: ImitationConfig = field(default_factory=ImitationConfig)  # training of the policy

    def __post_init__(self) -> None:
        require(self, ("pool", "refresh", "interval"), 1)
        require(self, ("played",), 0)
        require(self, ("seed",), 0, 2**31 - 1)
        require(self, ("validation",), 0, 1)
        if self.validation in (0, 1):
            raise ValueError(f"validation is {self.validation}: it must be above 0 and below 1")
