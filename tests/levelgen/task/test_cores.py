"""Environments spread over CPU cores by one process have the same bits as on one core."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.pace import patience

pytestmark = pytest.mark.slow

PROGRAM = """
import jax, numpy as np
from jax.sharding import AxisType, PartitionSpec
import levelproof

assert len(jax.devices()) == 2
env, params = levelproof.make(levelproof.sample_levels(np.arange(64), "s"))
own, keys = levelproof.starts(params.levels), jax.random.split(jax.random.key(0), 64)
action = jax.vmap(env.action_space(params).sample)(keys)
shared, split = PartitionSpec(), PartitionSpec("core")

def rollout(keys, state, action, params):
    step = jax.vmap(env.step, in_axes=(0, 0, 0, None))
    def act(state, _):
        _, state, reward, done, _ = step(keys, state, action, params)
        return state, (reward, done)
    return jax.lax.scan(act, state, length=24)

alone = jax.jit(rollout)(keys, own, action, params)
cores = jax.make_mesh((2,), ("core",), axis_types=(AxisType.Auto,))
divided = jax.jit(jax.shard_map(rollout, mesh=cores, in_specs=(split, split, split, shared),
                                out_specs=(split, PartitionSpec(None, "core")), check_vma=False))
jax.tree.map(np.testing.assert_array_equal, alone, divided(keys, own, action, params))
print("equal")
"""


def test_two_cores_give_the_same_bits_as_one() -> None:
    environment = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    root = Path(__file__).parents[3]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=root,
        env=environment,
        capture_output=True,
        text=True,
        timeout=patience(1800),
    )
    assert done.stdout.strip() == "equal", done.stderr
