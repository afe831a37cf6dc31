"""The policies that come with levelproof."""

import jax
import numpy as np
import pytest

from levelproof.experts.evaluation import do_nothing, play, play_sampled
from levelproof.experts.networks.saved import BUILTIN, BUILTIN_AT, PolicyError, load_policy
from levelproof.levelgen.sampling.sampler import FRESH_IDS, sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES

NAMES = sorted(folder.name for folder in BUILTIN_AT.iterdir())


def test_builtin_policies_are_small_and_say_how_they_were_made() -> None:
    assert NAMES == ["m", "s"]
    for name in NAMES:
        files = {path.name: path.stat().st_size for path in (BUILTIN_AT / name).iterdir()}
        assert set(files) == {"README.md", "config.json", "looks.jsonl", "policy.safetensors"}
        assert sum(files.values()) < 1_000_000
        assert "levelproof train" in (BUILTIN_AT / name / "README.md").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_builtin_policy_solves_levels_that_it_has_not_seen(name: str) -> None:
    """Far more than doing nothing does, on levels with ids that training never draws."""
    policy, ids = load_policy(f"{BUILTIN}{name}"), np.arange(FRESH_IDS, FRESH_IDS + 128, dtype=np.int32)
    levels = jax.device_get(sample_levels(ids, name))
    tries = play_sampled(policy.network)
    solved = play(tries, policy.params, levels, ids, 1, 0, DEFAULT_RULES).solved.mean()
    idle = play(do_nothing, (), levels, ids, 1, 0, DEFAULT_RULES).solved.mean()
    assert solved > idle + 0.15


def test_load_policy_names_the_builtin_ones() -> None:
    with pytest.raises(PolicyError, match="There is no policy builtin:x: levelproof comes with builtin:m, builtin:s"):
        load_policy("builtin:x")
