"""Compiling what tests call once: without XLA's optimiser it takes less than half as long, and rounds differently.

`python -m tests.quick` is the command `levelproof`, compiling like that.
"""

import os
import sys
from functools import partial
from pathlib import Path
from typing import Any

import jax
from jax._src import compiler

from levelproof.levelgen.programs import SOONEST, UNOPTIMISED, StoredProgram

FAST_COMPILING = "jax_disable_most_optimizations"  # a setting of JAX
# Tests that compile many programs and run each briefly. Records are kernels of our own, whose bits do not depend on
# XLA. No test here compares other bits with those of a process that optimises.
BRIEF = (
    "tests/experts/generalist/",
    "tests/experts/networks/",
    "tests/experts/search/test_vary",
    "tests/experts/test_evaluation",
    "tests/experts/test_policy",
    "tests/experts/training/test_ppo",
    "tests/experts/training/test_rollout",
    "tests/experts/verdict/test_portability",
    "tests/levelgen/task/",
    "tests/levelgen/test_mutate",
    "tests/levelgen/test_proofs",
    "tests/pipeline/dataset/",
    "tests/pipeline/exchange/",
    "tests/pipeline/hostile/",
    "tests/pipeline/learn/test_clone",
    "tests/pipeline/learn/test_distill",
    "tests/pipeline/learn/test_evaluate",
    "tests/pipeline/learn/test_train",
    "tests/pipeline/look/",
    "tests/pipeline/play/",
    "tests/pipeline/read/",
    "tests/pipeline/store/test_density",
    "tests/pipeline/store/test_hostile",
    "tests/pipeline/store/test_seed",
    "tests/pipeline/verify/",
    "tests/test_commands",
    "tests/test_docs",
)
MAX_MAPS = 40_000  # memory maps of a process, beyond which it drops its programs
jit_once = partial(jax.jit, compiler_options=dict(UNOPTIMISED))
options_of = compiler.get_compile_options  # JAX's own


def is_brief(nodeid: str) -> bool:
    """Whether a test's programs compile without XLA's optimiser."""
    return nodeid.startswith(BRIEF)


def fast_options(*given: Any, env_options_overrides: dict[str, Any] | None = None, **named: Any) -> Any:
    """Return the options of a program, as JAX does, with those that make compiling fastest.

    JAX has no setting for all of them, and the environment's would count for all modules of tests.
    """
    overrides = SOONEST | dict(env_options_overrides or {})
    return options_of(*given, env_options_overrides=overrides, **named)


def compile_for(nodeid: str) -> None:
    """Set whether XLA optimises what a module of tests jits, here and in processes that it starts."""
    brief = is_brief(nodeid)
    if jax.config.read(FAST_COMPILING) and not brief:
        jax.clear_caches()  # JAX would take the programs that were compiled without the optimiser
    jax.config.update(FAST_COMPILING, brief)
    os.environ[FAST_COMPILING.upper()] = str(int(brief))
    compiler.get_compile_options = fast_options if brief else options_of


def make_room() -> None:
    """Drop compiled programs when the process holds too many memory maps.

    Each program takes several maps. Linux allows a process 65,530, and XLA crashes when it gets no more. JAX reloads
    dropped programs from the cache folder.
    """
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MAX_MAPS:
        jax.clear_caches()
        modules = [module for name, module in sys.modules.items() if name.startswith("levelproof.")]
        for program in {each for module in modules for each in vars(module).values() if type(each) is StoredProgram}:
            program.forget()


if __name__ == "__main__":
    from levelproof.pipeline.cli.main import main

    compile_for(BRIEF[0])
    sys.exit(main())
