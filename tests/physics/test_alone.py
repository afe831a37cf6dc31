"""A lane's next state does not depend on its neighbours, to the bit, even if its world has broken down.

Other lanes decide what a block computes and what it skips (`physics.lanes`).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest

from levelproof.physics.block import Inputs
from levelproof.physics.codegen.buffers import LANES
from levelproof.physics.step import as_machine_code, on_all_lanes
from levelproof.physics.types import Params, Size
from tests.physics.codegen.kernels import same_bits
from tests.physics.worlds import scattered

SIZE = Size(polygons=6, circles=3, joints=4, thrusters=2)
STRONG = Params(motor_power=9000, thruster_power=300, joint_stiffness=0.9, max_velocity=1000)
RULES = {
    "usual": Params(),
    "strong": STRONG,
    "far": dataclasses.replace(STRONG, max_position=1e6, max_velocity=1e6, max_angular_velocity=1e4),
}
EXTREME = np.array([0, -0.0, 1e-40, -1e-40, 1e3, -1e6, 1e12, -1e25, 1e38, -1e38, np.inf, -np.inf, np.nan], np.float32)
LOPSIDED = np.array([(2, 1), (1, 1), (1, 1), (1, 1)], np.float32)[:, :, None]
Way = Callable[[Inputs, Params, bool], Any]


def wild(lanes: int, seed: int) -> Inputs:
    """Return worlds with some extreme values: none in half of the lanes, up to a fifth in others.

    Some lanes have lopsided, counterclockwise polygons, which touch at a distance.
    """
    random = np.random.default_rng(seed)

    def corrupt(x):
        if x.dtype != np.float32:
            return x
        share = random.choice([0, 0, 0.02, 0.2], lanes)
        return np.where(random.random(x.shape) < share, random.choice(EXTREME, x.shape), x)

    given = Inputs(*scattered(SIZE, lanes, seed))
    corners = np.where(random.random(lanes) < 0.3, given.model.vertices[:, ::-1] * LOPSIDED, given.model.vertices)
    model = dataclasses.replace(given.model, vertices=corners)
    control = given.motor * random.choice([1, 1, 100, -1e20], lanes).astype(np.float32)
    return given._replace(
        model=model, before=jax.tree.map(corrupt, given.before), motor=control, thrust=corrupt(given.thrust)
    )


@functools.cache
def stepped(way: Way, params: Params) -> Callable[[Inputs], list[np.ndarray]]:
    options = {"xla_backend_optimization_level": 0} if way is on_all_lanes else None  # compiles in half the time
    run = jax.jit(lambda given: way(given, params, True), compiler_options=options)
    return lambda given: [np.asarray(x) for x in jax.tree.leaves(run(given))]


def lanes_of(given: Inputs, lanes: np.ndarray) -> Inputs:
    return jax.tree.map(lambda x: np.asarray(x)[..., lanes], given)


@pytest.mark.slow
@pytest.mark.parametrize("rules", RULES)
@pytest.mark.parametrize("seed", [1, 2])
def test_machine_code_of_a_lane_ignores_its_neighbours(rules: str, seed: int) -> None:
    """Compare each lane in a block of its own copies with the same lane among others."""
    step, lanes = stepped(as_machine_code, RULES[rules]), 2048
    given, order = wild(lanes, seed), np.random.default_rng(seed).permutation(lanes)
    alone = step(lanes_of(given, np.repeat(order, LANES)))
    same_bits([x[..., ::LANES] for x in alone], step(lanes_of(given, order)))


@pytest.mark.campaign
@pytest.mark.parametrize("rules", ["far", "usual", "strong"])
def test_xla_step_of_a_lane_ignores_its_neighbours(rules: str) -> None:
    """Here all lanes are one block."""
    step, lanes = stepped(on_all_lanes, RULES[rules]), 64
    given = wild(lanes, 3)
    among = step(given)
    for lane in range(lanes):
        alone = step(lanes_of(given, np.full(lanes, lane)))
        same_bits([x[..., lane] for x in alone], [x[..., lane] for x in among])


@pytest.mark.parametrize("rules", RULES)
def test_wild_worlds_are_partly_broken(rules: str) -> None:
    step = stepped(as_machine_code, RULES[rules])
    given = wild(2048, 1)
    after = step(given)
    fine = np.all([np.isfinite(x).reshape(-1, 2048).all(0) for x in after], 0)
    assert 0.2 < fine.mean() < 0.9
