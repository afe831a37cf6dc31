"""Training on two devices of the CPU, in a process of its own: JAX has as many devices as it was set up with."""

import subprocess
import sys

import pytest

from tests.processors import ROOT

# Different levels and random numbers give each core another gradient
PROGRAM = """
import numpy as np
from levelproof.pipeline.runtime import prepare_jax
prepare_jax(devices=2)
import jax
from levelproof.experts.generalist.config import PPOConfig
from levelproof.experts.generalist.curricula import UNIFORM
from levelproof.experts.generalist.rollout import table_of
from levelproof.experts.generalist.train import TrainingRecipe, programs_of
from levelproof.experts.networks.over_levels import NetworkConfig
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES

network, ppo = NetworkConfig(width=8, depth=1, heads=1), PPOConfig(environments=16, horizon=8, minibatches=2, epochs=1)
table = table_of(sample_levels(np.arange(4), "s"), DEFAULT_RULES)
programs = programs_of(TrainingRecipe(network, SIZES["s"], ppo, UNIFORM, DEFAULT_RULES, 0), table, None, 2)
begun = programs.begin(table, None)
before = jax.device_get(begun.params)
learner, _ = programs.advance(begun, table, None)
changed = 0
for weights, were in zip(jax.tree.leaves(learner.params), jax.tree.leaves(before), strict=True):
    one, other = (np.asarray(shard.data) for shard in weights.addressable_shards)
    np.testing.assert_array_equal(one, other)
    changed += (one != were).sum()
assert changed
"""


@pytest.mark.slow
def test_cores_hold_the_same_weights_after_an_update() -> None:
    """They act in their own lanes, and average their gradients."""
    ran = subprocess.run([sys.executable, "-c", PROGRAM], cwd=ROOT, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
