"""The benchmark of env steps/s in reinforcement learning, on a tiny run."""

from pathlib import Path

import pytest

from benchmarks.__main__ import parser
from benchmarks.ppo import run
from levelproof.pipeline.runtime import own_cores

pytestmark = pytest.mark.campaign


def test_rates_are_those_of_one_core_and_of_all(tmp_path: Path) -> None:
    small = "ppo.environments=32", "ppo.minibatches=4", "network.width=8"
    words = ["ppo", "--env-steps", "8192", "--folder", str(tmp_path), "--set", *small]
    results = run(parser("ppo").parse_args(words)).results
    assert [each["cores"] for each in results] == sorted({1, len(own_cores())})
    for each in results:
        assert each["rate"] > 0
        assert each["env_steps"] == 8192
