"""The settings of `levelproof distill`."""

from dataclasses import dataclass, field
from typing import Literal

from levelproof.experts.generalist.teachers import TeachersConfig
from levelproof.experts.imitation import ImitationConfig
from levelproof.experts.networks.over_levels import NetworkConfig
from levelproof.physics.bounds import require

# Differ from the defaults of cloning because most runs start from a policy
TRAIN = ImitationConfig(updates=2000, learning_rate=2e-4, warmup=100, average=0.99)


@dataclass(frozen=True)
class DistillConfig:
    """Choice of the learner's states that teachers label, and training on these labels and on demonstrations."""

    where: str = "label = 'solved'"  # SQL condition on the manifest's columns that selects levels
    start: str = ""  # folder of a policy to continue training, with its network; empty: from scratch
    pool: int = 16_384  # levels to learn from, drawn for the whole run if the split has more
    interval: int = 100  # updates between rounds in which teachers label states; each ends with a checkpoint
    episodes: int = 512  # episodes that the learner plays in a round, each in another level
    states: int = 256  # states of these episodes that teachers label in a round; 0: none
    failed: float = 0.9  # share of the states asked about from episodes that did not reach the goal
    demonstrations: int = 0  # episodes of kept experts in a round, most with noise, at most one of each expert
    path: int = 16  # maximum env steps to learn from a teacher's path to the goal, evenly spaced; 1: only the first
    buffer: int = 65_536  # transitions of teachers in memory, the latest ones
    witnesses: float = 0.5  # share of the transitions of an update that are from the levels' witnesses
    seed: int = 0  # seed of the initial weights and of all random draws
    log: Literal["none", "tensorboard", "wandb"] = "none"  # logger of scalars, besides metrics.jsonl
    network: NetworkConfig = field(default_factory=NetworkConfig)  # network of a policy from scratch
    teachers: TeachersConfig = field(default_factory=TeachersConfig)  # attempts and demonstrations of the teachers
    train: ImitationConfig = TRAIN  # training of the policy

    def __post_init__(self) -> None:
        require(self, ("pool", "interval", "episodes", "path", "buffer"), 1)
        require(self, ("states", "demonstrations"), 0)
        require(self, ("failed", "witnesses"), 0, 1)
        require(self, ("seed",), 0, 2**31 - 1)
        if self.witnesses == 1:
            raise ValueError("witnesses is 1: set it below 1, or nothing is learned from teachers")
        if not (self.states or self.demonstrations):
            raise ValueError("states and demonstrations are both 0: set one of them above 0, or use `levelproof clone`")
