"""Compiling what tests call once: without XLA's optimiser it takes half as long, and rounds a little differently."""

import os
from functools import partial

import jax

from levelproof.levelgen.quick import UNOPTIMISED

FAST_COMPILING = "jax_disable_most_optimizations"  # a setting of JAX
# Tests that compile many programs and run each briefly. Records are kernels of our own, whose bits do not depend on
# XLA. No test here compares other bits with those of a process that optimises.
BRIEF = (
    "tests/experts/generalist/",
    "tests/experts/networks/",
    "tests/experts/test_evaluation",
    "tests/experts/test_policy",
    "tests/experts/training/test_ppo",
    "tests/levelgen/task/",
    "tests/pipeline/dataset/",
    "tests/pipeline/exchange/",
    "tests/pipeline/hostile/",
    "tests/pipeline/learn/test_clone",
    "tests/pipeline/learn/test_evaluate",
    "tests/pipeline/learn/test_train",
    "tests/pipeline/look/",
    "tests/pipeline/play/",
    "tests/pipeline/read/",
    "tests/pipeline/store/test_density",
    "tests/pipeline/store/test_hostile",
    "tests/pipeline/verify/",
    "tests/test_docs",
)
jit_once = partial(jax.jit, compiler_options=UNOPTIMISED)


def is_brief(nodeid: str) -> bool:
    """Whether a test's programs compile without XLA's optimiser."""
    return nodeid.startswith(BRIEF)


def compile_for(nodeid: str) -> None:
    """Set whether XLA optimises what a module of tests jits, here and in processes that it starts."""
    brief = is_brief(nodeid)
    if jax.config.read(FAST_COMPILING) and not brief:
        jax.clear_caches()  # JAX would take the programs that were compiled without the optimiser
    jax.config.update(FAST_COMPILING, brief)
    os.environ[FAST_COMPILING.upper()] = str(int(brief))
