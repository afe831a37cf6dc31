"""Calls to time in the training of experts: a rollout, and an update."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.endless import endless_slots, update_slots
from levelproof.experts.config import ExpertConfig
from levelproof.experts.policy import network_of
from levelproof.experts.training import ppo
from levelproof.experts.training.advance import sample_rows
from levelproof.experts.training.ppo import LevelConstants
from levelproof.experts.training.rollout import ActionRule, rollout, start
from levelproof.levelgen.batching import repeat
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.actions import action_mask
from levelproof.levelgen.task.rules import DEFAULT_RULES


def calls(levels: Level, config: ExpertConfig) -> Iterator[Callable[[], Any]]:
    """Yield functions without arguments that run a rollout and an update."""
    count = levels.role.shape[-1]
    slots, _ = update_slots(endless_slots(levels, np.arange(count), config), config)
    experts, levels = slots.slot.training.train_state, jax.tree.map(jnp.asarray, levels)
    experts = jax.tree.map(jnp.copy, experts)  # `update_slots` donates its slots
    lanes, network = config.environments * count, network_of(levels.size, config)
    manner = ActionRule.sampling(lanes, count)
    keys, acting = jax.random.split(jax.random.key(0), count), start(repeat(levels, config.environments))
    ours = config.horizon, DEFAULT_RULES
    act = jax.jit(lambda params, acting: rollout(network, params, levels, acting, keys, manner, *ours))
    yield partial(act, experts.params, acting)

    _, trajectory, last_value = act(experts.params, acting)
    rows = sample_rows(trajectory, last_value, manner.rehearsing, config)
    constants = LevelConstants(network.constant(levels), action_mask(levels))
    constants = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), constants)

    @jax.jit
    def update(experts):
        one = lambda inputs: ppo.update(inputs[0], inputs[1], network, inputs[2], inputs[3], config)
        return jax.lax.map(one, (experts, keys, constants, rows))

    yield partial(update, experts)
