"""Machine code for another processor gives the same bits, because every operation is rounded separately."""

import hashlib
import sys
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest
from llvmlite import binding

from levelproof.levelgen.level import SIZES
from levelproof.physics.block import Inputs
from levelproof.physics.buffers import buffers_of
from levelproof.physics.codegen.buffers import LANES
from levelproof.physics.step import as_annotated, kernel_of, step
from levelproof.physics.types import DEFAULT_PARAMS, State
from tests import arm
from tests.golden.load import golden
from tests.processors import PROCESSORS, become, run_on

STEPS = 8


def digest(size: str) -> str:
    """Hash the states some steps after the golden ones."""
    return digest_after(
        size, jax.jit(lambda inputs: step(inputs.model, inputs.before, *inputs[2:], with_contacts=False)[0])
    )


def digest_after(size: str, advance: Callable[[Inputs], State]) -> str:
    """Hash the states after STEPS calls of `advance` on the golden ones."""
    sample = golden(size)
    inputs = Inputs(sample.level.model, sample.state, sample.motor, sample.thrust)
    for _ in range(STEPS):
        inputs = inputs._replace(before=advance(inputs))
    total = hashlib.sha256()
    for leaf in jax.tree.leaves(inputs.before):
        x = np.array(leaf)
        x[x != x] = np.nan  # no standard defines the sign of a NaN, which ends the episode anyway
        total.update(x.tobytes())
    return total.hexdigest()


@pytest.mark.slow
@pytest.mark.skipif("baseline" not in PROCESSORS, reason="the baseline processor is only known for x86")
@pytest.mark.parametrize("size", ["s", pytest.param("l", marks=pytest.mark.campaign)])
def test_step_for_an_old_processor_gives_the_same_bits(size: str) -> None:
    cpu, theirs = run_on("baseline", "tests.physics.test_machines", size).split()
    assert cpu != binding.get_host_cpu_name()
    assert theirs == digest(size)


@arm.needs_emulator
@pytest.mark.campaign
@pytest.mark.parametrize("cpu", arm.EMULATED)
@pytest.mark.parametrize("size", ["s", "l"])
def test_step_on_an_emulated_arm_processor_gives_the_same_bits(size: str, cpu: str, tmp_path: Path) -> None:
    emulated = arm.Emulated(
        kernel_of(SIZES[size], DEFAULT_PARAMS, False, buffers_of(Inputs, SIZES[size])), cpu, tmp_path
    )

    def advance(inputs: Inputs) -> State:
        whole, lanes = as_annotated(inputs)
        pad = lambda x: np.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, -lanes % LANES)], mode="edge")
        state, _ = emulated(jax.tree.map(pad, whole))
        return jax.tree.map(lambda x: x[..., :lanes], state)

    assert digest_after(size, advance) == digest(size)


if __name__ == "__main__":
    become(sys.argv[1])
    print(binding.get_host_cpu_name(), digest(sys.argv[2]))
