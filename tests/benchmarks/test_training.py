"""The benchmarks of training: every timed call runs and gives finite numbers."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from benchmarks import networks, training
from levelproof.experts.config import ExpertConfig, Network
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels

pytestmark = pytest.mark.campaign
CONFIG = ExpertConfig(
    environments=8, horizon=8, width=8, encoding=8, attempts=1, sticky_attempts=0, perturbed_attempts=0, rehearsals=0
)


def test_calls_give_finite_numbers() -> None:
    levels = jax.device_get(sample_levels(np.arange(2), SIZES["s"]))
    (acting, seen, value), expert = (jax.device_get(call()) for call in training.calls(levels, CONFIG))
    for x in jax.tree.leaves((acting.world.state, seen.reward, value, expert)):
        assert np.isfinite(x).all()


def test_rates_cover_every_network(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"REPEATS": 1, "UPDATES": 1, "SLOTS": 2}.items():
        monkeypatch.setattr(networks, name, value)
    for kind in Network:
        monkeypatch.setitem(networks.CONFIGS, kind.value, replace(CONFIG, network=kind))
    rates = networks.rates(SIZES["s"])
    assert list(rates) == ["flat", "entity"]
    assert min(rates.values()) > 0
