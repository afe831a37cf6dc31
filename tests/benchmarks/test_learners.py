"""The benchmark of reinforcement, on policies that train for two updates."""

from pathlib import Path

import pytest

from benchmarks.__main__ import parser
from benchmarks.learners import STEPS, run

pytestmark = pytest.mark.campaign
TINY = ("ppo.environments=64", "ppo.horizon=32", "ppo.minibatches=4", "interval=1")


def test_learners_are_trained_measured_and_kept(tmp_path: Path) -> None:
    words = ["learners", "--ways", "from scratch", "from builtin:s", "--env-steps", "16384", "--measured", "8"]
    args = parser("learners").parse_args([*words, "--folder", str(tmp_path / "kept"), "--set", *TINY])
    first = run(args)
    assert [row[0] for row in first.tables[0].rows][:3] == ["builtin:s", "from scratch", "from builtin:s"]
    assert [each["curve"][-1][STEPS] for each in first.results[:2]] == [16384, 16384]
    for name, draw in first.plots.items():
        draw(tmp_path / name)
        assert (tmp_path / name).read_text().rstrip().endswith("</svg>")
    assert run(args).results == first.results
