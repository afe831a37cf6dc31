"""Machine code for another processor gives the same bits, because every operation is rounded separately."""

import hashlib
import platform
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from llvmlite import binding

from levelproof.physics.step import step
from tests.golden.load import HERE, load

STEPS = 8
PLAIN = {
    "x86_64": "x86-64",
    "AMD64": "x86-64",
}  # the architecture's baseline: 128-bit vectors, no fused operations


class NoFeatures:
    """The features of a baseline processor: none."""

    def flatten(self) -> str:
        return ""


def digest(size: str) -> str:
    """Hash the states some steps after the golden ones."""
    golden = load(HERE / f"{size}.npz")
    state = golden.state
    compiled = jax.jit(lambda *given: step(*given, seen=False)[0])
    for _ in range(STEPS):
        state = compiled(golden.level.model, state, golden.motor, golden.thrust)
    total = hashlib.sha256()
    for leaf in jax.tree.leaves(state):
        x = np.array(leaf)
        x[x != x] = np.nan  # no standard defines the sign of a NaN, which ends the episode anyway
        total.update(x.tobytes())
    return total.hexdigest()


@pytest.mark.skipif(platform.machine() not in PLAIN, reason="the baseline processor is only known for x86")
@pytest.mark.parametrize("size", ["s", pytest.param("l", marks=pytest.mark.campaign)])
def test_step_for_an_old_processor_gives_the_same_bits(size: str) -> None:
    command = [sys.executable, "-m", "tests.physics.test_machines", size]
    ran = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True)
    cpu, theirs = ran.stdout.split()
    assert cpu != binding.get_host_cpu_name()
    assert theirs == digest(size)


if __name__ == "__main__":
    processor = PLAIN[platform.machine()]
    binding.get_host_cpu_name = lambda: processor
    binding.get_host_cpu_features = NoFeatures
    print(processor, digest(sys.argv[1]))
