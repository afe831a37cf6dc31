"""Either network learns in slots, and a level's result does not depend on its slot."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from levelproof.experts.config import Network
from levelproof.experts.verdict.judge import TrainedLevel
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from tests.experts.small import CONFIG
from tests.experts.training.test_slots import SOLVED, UPDATES, same, train

IDS = np.array([0, 2, 6, 7])


def trained(network: Network, at: list[int]) -> list[TrainedLevel]:
    levels = jax.tree.map(np.asarray, sample_levels(IDS, SIZES["s"]))
    config = replace(CONFIG, network=network, encoding=16)
    return train(take(levels, np.array(at)), IDS[at], UPDATES, config, SOLVED)[0]


@pytest.mark.campaign
@pytest.mark.parametrize("network", Network)
def test_networks_learn_real_levels_in_any_slot(network: Network) -> None:
    every = trained(network, [0, 1, 2, 3])
    solved = [bool(level.candidates) for level in every]
    assert sum(solved) >= 3
    assert min(len(level.curve) for level in every) < UPDATES
    for i, level in zip([2, 0, 1], trained(network, [2, 0, 1]), strict=True):
        same(level, every[i])
