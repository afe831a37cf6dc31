"""Fuzzing target of policies: the JSON that describes one, and its weights."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from random import Random

import jax
import numpy as np

from levelproof.experts.networks.over_levels import PolicyKind
from levelproof.experts.networks.saved import CONFIG, WEIGHTS, load_policy, save_policy
from levelproof.levelgen.level import SIZES
from tests.pipeline.hostile.mutations import mutate_bytes, mutate_json, put, remove
from tests.pipeline.made import small_policy


def policies(folder: Path) -> Callable[[Random], None]:
    """Return a target that reads a policy of which one file is mutated."""
    path, origin = folder / "policy", {"settings": {"seed": 0}, "made_by": [{"jax": "0.10.2"}]}
    whole = replace(small_policy(SIZES["s"], PolicyKind.FLAT), origin=origin)
    save_policy(path, whole)
    good = {name: (path / name).read_bytes() for name in (CONFIG, WEIGHTS)}
    shapes = jax.tree.map(np.shape, whole.params)

    def target(random: Random) -> None:
        for name, data in good.items():
            remove(path / name)
            (path / name).write_bytes(data)
        name = random.choice((CONFIG, CONFIG, WEIGHTS))
        remove(path / name)
        raw = good[name]
        put(path / name, mutate_json(json.loads(raw), random) if name == CONFIG else mutate_bytes(raw, random), random)
        policy = load_policy(path)
        assert policy.size in (None, whole.size)
        assert isinstance(policy.origin, dict)
        assert jax.tree.map(np.shape, policy.params) == shapes

    return target
