"""Settings of training one policy over many levels."""

import math
from contextlib import suppress
from dataclasses import dataclass, replace

from levelproof.levelgen.task.rules import MAX_REWARD_SCALE, TaskParams
from levelproof.physics.bounds import require

CHUNK = 256  # lanes and samples of a core are multiples of it, or fewer; measured levels are padded to a multiple

MAX_REPEAT = 256  # env steps; an episode of the default rules is then one action


@dataclass(frozen=True)
class PPOConfig:
    """Hyperparameters of training (hashable: pass as a static argument)."""

    env_steps: int = 80_000_000  # env steps of all lanes; training ends with the update that reaches them
    environments: int = 2048  # lanes, divided evenly among the cores
    horizon: int = 64  # actions in each lane between updates
    repeat: int = 4  # env steps that each action lasts in training; a policy that plays acts in every one
    dense_reward_scale: float = 0.2  # 1/m; shaping reward in training, in place of the task's
    subsample: float = 0.5  # share of the samples that are learned from, large advantages more often; 1: all
    epochs: int = 2  # passes over the samples of an update
    minibatches: int = 32  # updates of the weights in an epoch
    learning_rate: float = 1e-3  # Adam's step size
    adam_epsilon: float = 1e-5  # Adam's epsilon
    max_gradient_norm: float = 1.0  # maximum global norm of the gradient
    discount: float = 0.995  # discount factor of rewards, per env step
    gae_lambda: float = 0.9  # lambda of advantage estimates, per action (Schulman et al. 2016, arXiv:1506.02438)
    clip: float = 0.2  # maximum change of the probability ratio, and of the value, in either direction
    value_weight: float = 0.5  # weight of the value function's loss
    entropy_weight: float = 0.005  # weight of the policy's entropy, a bonus in the loss
    average: float = 0.95  # maximum decay of the averaged weights, the policy; at update n at most n/(n+9)
    # with start=POLICY
    critic_updates: int = 10  # first updates, which fit the value function and leave the policy as it is
    kl_weight: float = 0.0  # weight of the divergence from the start, a penalty in the loss; falls linearly to 0
    kl_updates: int = 60  # updates after critic_updates over which kl_weight falls to 0

    def __post_init__(self) -> None:
        require(self, ("env_steps", "environments", "horizon", "epochs", "minibatches"), 1)
        require(self, ("repeat",), 1, MAX_REPEAT)
        require(self, ("learning_rate", "adam_epsilon", "max_gradient_norm"), 0, above=True)
        require(self, ("subsample",), 0, 1, above=True)
        require(self, ("discount", "gae_lambda", "clip", "average"), 0, 1)
        require(self, ("value_weight", "entropy_weight", "kl_weight"), 0)
        require(self, ("dense_reward_scale",), 0, MAX_REWARD_SCALE)
        require(self, ("critic_updates", "kl_updates"), 0)
        if self.horizon == 1 and self.repeat < MAX_REPEAT:
            raise ValueError(
                "horizon is 1: set it to at least 2, because a rollout's last action counts only if it ends its episode"
            )

    @property
    def steps_per_update(self) -> int:
        """Env steps of all lanes per update."""
        return self.environments * self.horizon * self.repeat

    @property
    def updates(self) -> int:
        """Updates in `env_steps`."""
        return -(-self.env_steps // self.steps_per_update)

    def training_rules(self, rules: TaskParams) -> TaskParams:
        """Return the rules of training: those of the task, with this shaping reward, an action per `repeat` env steps.

        Goal and red are still checked after every physics step, so what ends an episode stays the same; only the
        time limit is rounded up to a whole number of actions.
        """
        return replace(
            rules,
            dense_reward_scale=self.dense_reward_scale,
            frame_skip=rules.frame_skip * self.repeat,
            max_timesteps=-(-rules.max_timesteps // self.repeat),
        )

    def divides_evenly(self, cores: int) -> bool:
        """Whether this number of cores divides the lanes evenly, and minibatches the chunks of a core."""
        with suppress(ValueError):
            return bool(self.samples(cores))
        return False

    def samples(self, cores: int) -> int:
        """Return the number of samples per time step that a core learns from: a whole number of chunks, rounded down.

        Raises:
            ValueError: the cores do not divide the lanes evenly, or the minibatches the chunks of a core.
        """
        lanes, over = divmod(self.environments, cores)
        width = min(lanes, CHUNK)
        if over or lanes % width:
            raise ValueError(
                f"environments is {self.environments}: with {cores} core{'s' * (cores != 1)} it must be a multiple of "
                f"{cores if self.environments < cores * CHUNK else cores * CHUNK}"
            )
        some = max(int(round(lanes * self.subsample, 6)), 1)  # 0.29 times 25600 is a little less than 7424
        some -= some % min(some, CHUNK)
        if (chunks := some // min(some, CHUNK) * self.horizon) % self.minibatches:
            raise ValueError(
                f"minibatches is {self.minibatches}: it must divide {chunks}, the number of chunks of samples that "
                f"each core learns from (horizon = {self.horizon}, subsample = {self.subsample:g})"
            )
        return some


@dataclass(frozen=True)
class LearnabilityConfig:
    """Settings of the curriculum by learnability (hashable: pass as a static argument)."""

    share: float = 0.75  # share of episodes in levels that the measurement kept, however few; the others draw from all
    every: int = 16  # updates between measurements
    candidates: int = 4096  # levels that are measured, drawn from all
    measured_steps: int = 512  # env steps of a measurement in each level; episodes have up to 256
    keep: int = 1536  # levels that are kept, those with the highest learnability

    def __post_init__(self) -> None:
        require(self, ("share",), 0, 1)
        require(self, ("every", "candidates", "measured_steps", "keep"), 1)
        if self.keep > self.candidates:
            raise ValueError(f"keep is {self.keep}: it must not exceed candidates = {self.candidates}")


@dataclass(frozen=True)
class ReplayConfig:
    """Settings of the buffer of levels to replay (hashable: pass as a static argument).

    Values of Jiang et al. 2021 (arXiv:2110.02439) for mazes, except the temperature: at theirs, 0.3, some 60% of all
    replays would be of one level.
    """

    share: float = 0.5  # share of episodes that replay a level, once the buffer is full enough
    capacity: int = 4000  # levels in the buffer
    full_enough: float = 0.5  # share of slots with attempted levels from which replay starts
    temperature: float = 1.0  # the weight of a level's score is its rank to the power of -1/temperature
    staleness: float = 0.3  # weight of the updates since a level's last episode in its replay probability

    def __post_init__(self) -> None:
        require(self, ("share", "full_enough", "staleness"), 0, 1)
        require(self, ("temperature",), 0, above=True)
        require(self, ("capacity",), 1, 2**20)
        if self.share == 1:
            raise ValueError("share is 1: set it below 1, or no new level is ever played")

    @property
    def enough(self) -> int:
        """Number of attempted levels from which replay starts."""
        return math.ceil(round(self.full_enough * self.capacity, 6))  # 0.07 * 100 is a little more than 7


@dataclass(frozen=True)
class EvolveConfig:
    """Settings of the curriculum that edits the levels of the buffer (hashable: pass as a static argument)."""

    every: int = 4  # updates between generations
    children: int = 64  # edited copies made per generation
    edits: int = 2  # random edits from parent to child

    def __post_init__(self) -> None:
        require(self, ("every", "children", "edits"), 1)
