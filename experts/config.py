"""What an expert is and how it learns. Defaults: the hyperparameters of the reference's PPO, vmapped per level."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ExpertConfig:
    """Hyperparameters of one expert (hashable: pass as a static argument)."""

    # network
    width: int = 64  # units of a hidden layer
    depth: int = 2  # hidden layers of the policy and of the value function, which share none
    # experience
    environments: int = 32  # lanes an expert acts in
    horizon: int = 64  # env steps in each lane between updates
    dense_reward_scale: float = 0.2  # 1/m; shaping while training, see levelgen.task.TaskParams
    # PPO (Schulman et al. 2017, arXiv:1707.06347)
    epochs: int = 4  # passes over the experience of an update
    minibatches: int = 4  # per epoch
    learning_rate: float = 3e-4
    adam_epsilon: float = 1e-5
    max_gradient_norm: float = 1.0  # global norm of one expert's gradient
    discount: float = 0.995  # per env step
    gae_lambda: float = 0.9  # Schulman et al. 2016, arXiv:1506.02438
    clip: float = 0.2  # of the probability ratio, and of the value's change
    value_weight: float = 0.5
    entropy_weight: float = 0.01
    # evaluation
    attempts: int = 8  # records rolled out at the end: the first by the most probable actions, the others sampled
    # machine
    slots: int = 0  # experts that train side by side in one program; 0: as many as suit the device

    def __post_init__(self) -> None:
        at_least_one = ("width", "depth", "environments", "horizon", "epochs", "minibatches", "attempts")
        for name in at_least_one:
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be at least 1")
        for name in ("learning_rate", "adam_epsilon", "max_gradient_norm"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be above 0")
        for name in ("discount", "gae_lambda", "clip"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be between 0 and 1")
        for name in ("dense_reward_scale", "value_weight", "entropy_weight", "slots"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} is {getattr(self, name)}: it must not be negative")
        if self.steps_per_update % self.minibatches:
            raise ValueError(
                f"minibatches is {self.minibatches}: it must divide environments x horizon = {self.steps_per_update}"
            )
        if self.attempts > self.environments:
            raise ValueError(f"attempts is {self.attempts}: it must not be above environments = {self.environments}")

    @property
    def steps_per_update(self) -> int:
        """Environment steps of one expert between updates."""
        return self.environments * self.horizon
