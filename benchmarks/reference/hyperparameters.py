"""Hyperparameters of the PPO that the reference's users would write today for one level.

Named as in `experts.config.ExpertConfig`. Imports the standard library only, because both sides import it.
"""

from typing import NamedTuple


class Hyperparameters(NamedTuple):
    width: int = 64
    depth: int = 2
    environments: int = 32
    horizon: int = 64
    dense_reward_scale: float = 0.2
    epochs: int = 4
    minibatches: int = 4
    learning_rate: float = 3e-4
    adam_epsilon: float = 1e-5
    max_gradient_norm: float = 1.0
    discount: float = 0.995
    gae_lambda: float = 0.9
    clip: float = 0.2
    value_weight: float = 0.5
    entropy_weight: float = 0.01


PPO = Hyperparameters()
