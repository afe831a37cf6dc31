"""Training on two devices of the CPU, in a process of its own: JAX has as many devices as it was set up with."""

import subprocess
import sys

import pytest

from tests.pace import patience
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

# Every other level can be solved, the rest have no goal; the candidates fill neither chunks nor cores evenly
MEASURE = """
from dataclasses import replace
import numpy as np
from levelproof.pipeline.runtime import prepare_jax
prepare_jax(devices=2)
import jax
import jax.numpy as jnp
from levelproof.experts.generalist.config import PPOConfig
from levelproof.experts.generalist.curricula import UNIFORM
from levelproof.experts.generalist.rollout import table_of
from levelproof.experts.generalist.train import TrainingRecipe, programs_of
from levelproof.experts.networks.over_levels import NetworkConfig
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import SIZES, Role
from levelproof.levelgen.proofs import stay_idle
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES

levels = jax.device_get(sample_levels(np.arange(128), "s"))
levels = take(levels, np.repeat(np.flatnonzero(stay_idle(levels, DEFAULT_RULES, 64).reaches)[:5], 2))
hopeless = np.arange(len(levels)) % 2 == 1
levels = replace(levels, role=np.where(hopeless & (levels.role == Role.BLUE), Role.PLAIN, levels.role))
candidates = np.random.default_rng(0).integers(0, len(levels), 601).astype(np.int32)
curriculum = UNIFORM._replace(
    every=1,
    begin=lambda: (jnp.zeros(601, jnp.int32),) * 2,
    measure=lambda table, attempt, key: attempt(jnp.asarray(candidates), 512, key),
)
network, ppo = NetworkConfig(width=8, depth=1, heads=1), PPOConfig(environments=16, horizon=8, minibatches=2, epochs=1)
table = table_of(levels, DEFAULT_RULES)
recipe = TrainingRecipe(network, SIZES["s"], ppo, curriculum, ppo.training_rules(DEFAULT_RULES), 0)
for cores in (1, 2):
    programs = programs_of(recipe, table, None, cores)
    episodes, solved = jax.device_get(programs.between_updates(programs.begin(table, None), table).curriculum)
    assert (episodes >= 2).all(), "an episode has up to 256 env steps"
    assert not solved[hopeless[candidates]].any()
    assert (solved[~hopeless[candidates]] > 0).mean() > 0.8
"""


@pytest.mark.slow
def test_attempts_count_for_the_level_that_was_measured() -> None:
    ran = subprocess.run(
        [sys.executable, "-c", MEASURE], cwd=ROOT, capture_output=True, text=True, timeout=patience(1800)
    )
    assert ran.returncode == 0, ran.stderr


@pytest.mark.slow
def test_cores_hold_the_same_weights_after_an_update() -> None:
    """They act in their own lanes, and average their gradients."""
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=ROOT, capture_output=True, text=True, timeout=patience(1800)
    )
    assert ran.returncode == 0, ran.stderr
