"""Levels and random streams do not depend on the user's JAX settings."""

import hashlib
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from levelproof.levelgen.identity.content import content_hashes
from levelproof.levelgen.identity.keys import Stream, key_for
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from tests.experts.random_play import random_successes
from tests.experts.small import IDS
from tests.pace import patience

ROOT = Path(__file__).parents[3]
FLAGS = {
    "JAX_THREEFRY_PARTITIONABLE": "0",
    "JAX_RANDOM_SEED_OFFSET": "7",
    "JAX_DEFAULT_PRNG_IMPL": "rbg",
    "JAX_ENABLE_CUSTOM_PRNG": "1",
    "JAX_LEGACY_PRNG_KEY": "error",
    "JAX_DEFAULT_MATMUL_PRECISION": "BF16_BF16_F32",
}
DRAWS: dict[str, Callable[[Any], Any]] = {
    "bits": lambda key: jax.random.bits(key, (5, 3)),
    "uniform": lambda key: jax.random.uniform(key, (5,)),
    "normal": lambda key: jax.random.normal(key, (5,)),
    "randint": lambda key: jax.random.randint(key, (5,), 0, 1000),
    "split": lambda key: jax.random.key_data(jax.random.split(key, 3)),
    "fold_in": lambda key: jax.random.key_data(jax.random.fold_in(key, 3)),
}
# Sources of randomness that affect no result: shapes only; what a page shows of a running expert
HARMLESS = {"levelgen/task/environment.py", "pipeline/play/training.py"}


def digest(arrays: Any) -> str:
    return hashlib.sha256(b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(arrays))).hexdigest()[:16]


def results() -> Iterator[str]:
    """Yield digests of draws from every stream, of levels, and of random play in them, one per line."""
    yield digest(jax.jit(lambda: {stream: {f: DRAWS[f](key_for(5, stream)) for f in DRAWS} for stream in Stream})())
    levels = sample_levels(IDS, SIZES["s"])
    yield " ".join(content_hashes(levels))
    yield digest(random_successes(levels, IDS))


@pytest.mark.parametrize("name", DRAWS)
def test_callers_jax_flag_leaves_draws_unchanged(name: str) -> None:
    key, draw = key_for(5, Stream.EXPERT), DRAWS[name]
    usual = np.asarray(draw(key))
    with jax.threefry_partitionable(False):
        np.testing.assert_array_equal(usual, np.asarray(draw(key)))
        np.testing.assert_array_equal(usual, np.asarray(jax.jit(draw)(key)))


@pytest.mark.campaign
def test_environment_variables_leave_levels_and_random_play_unchanged() -> None:
    command = [sys.executable, "-m", "tests.levelgen.identity.test_flags"]
    folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    environment = os.environ | FLAGS | ({"JAX_COMPILATION_CACHE_DIR": folder} if folder else {})
    theirs = subprocess.check_output(command, cwd=ROOT, env=environment, text=True, timeout=patience(1800))
    assert theirs.splitlines() == list(results())


def test_random_draws_use_only_the_keys_of_levels() -> None:
    unkeyed = {
        str(path.relative_to(ROOT))
        for layer in ("physics", "levelgen", "experts", "pipeline")
        for path in (ROOT / layer).rglob("*.py")
        if re.search(r"random\.key\(|PRNGKey\(|wrap_key_data\(", path.read_text())
    }
    assert unkeyed == HARMLESS | {"levelgen/identity/keys.py"}


if __name__ == "__main__":
    for line in results():
        print(line)
