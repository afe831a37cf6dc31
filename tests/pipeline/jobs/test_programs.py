"""Programs of a job, known from its settings alone."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.extend.core
import jax.numpy as jnp
import numpy as np
import pytest
from jax import monitoring

from levelproof.configs.schema import JobConfig
from levelproof.experts.pool.pool import Pool
from levelproof.experts.pool.programs import Program, programs_of
from levelproof.experts.pool.run import TrainingRun
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.programs import UNOPTIMISED
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.physics.codegen.compile import NAME
from levelproof.pipeline.claims import try_claim
from levelproof.pipeline.jobs.ahead import DONE, Ahead
from levelproof.pipeline.jobs.unit import pool_for
from levelproof.pipeline.runtime import CACHE_VARIABLE
from tests.pipeline.command import TINY
from tests.pipeline.made import made_job

ROOT = Path(__file__).parents[3]
SIZE = SIZES["s"]


@pytest.fixture(scope="module")
def job() -> JobConfig:
    return made_job("data", *TINY)


@pytest.fixture(scope="module")
def pool(job: JobConfig) -> Pool:
    return pool_for(job)


@pytest.fixture(scope="module")
def programs(pool: Pool) -> list[Program]:
    return programs_of(pool, SIZE)


@pytest.fixture
def claims(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder for claims in which no program is compiled; JAX's own stays."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    (tmp_path / "jax").mkdir()
    return tmp_path / "jax"


@pytest.mark.slow
def test_levels_compile_no_program_that_was_compiled_ahead(job: JobConfig, pool: Pool, claims: Path) -> None:
    one, other = Ahead(job, pool), Ahead(job, pool)
    programs = [*one._programs.values()]
    counts = [(other if turn % 2 else one).compile_next() for turn in range(len(programs))]
    assert counts == [(done, len(programs)) for done in range(1, len(programs) + 1)]
    assert one.compile_next() is None
    assert not other.left
    assert min(one.compiling, other.compiling) > 0
    compiled: list[str] = []
    monitoring.register_event_duration_secs_listener(
        lambda event, seconds, fun_name="", **_: compiled.append(fun_name) if "backend_compile" in event else None
    )
    ids = np.arange(4, dtype=np.int32)
    run = TrainingRun(pool, sample_levels(ids, SIZE, job.distribution), ids)
    while not run.submission or run.submission.under_way:
        pool.step()
        run.submit_searched()
    run.finish()
    jax.jit(lambda x: x + len(programs))(ids)
    names = {program.function.__name__ for program in programs}
    assert compiled, "the listener missed the program that was compiled just now"
    assert not names & {name.removeprefix("jit(").removesuffix(")") for name in compiled}


def test_ahead_skips_what_another_process_compiles(job: JobConfig, pool: Pool, claims: Path) -> None:
    ahead = Ahead(job, pool)
    paths = [*ahead._programs]
    held = [try_claim(path) for path in paths]
    assert ahead.compile_next() is None
    assert ahead.compiled == (0, len(paths))
    for file in held:
        assert file
        file.write(DONE)
        file.close()
    assert Ahead(job, pool).compiled == (len(paths), len(paths))
    assert not ahead.left


def test_ahead_compiles_again_under_other_flags(
    job: JobConfig, pool: Pool, claims: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = Ahead(job, pool)._programs.keys()
    assert before == Ahead(job, pool)._programs.keys()
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_prefer_vector_width=256")
    assert before.isdisjoint(Ahead(job, pool)._programs)


def test_programs_without_optimiser_multiply_no_floats(programs: list[Program]) -> None:
    quick = [program for program in programs if program.function.options == UNOPTIMISED]
    decorated = [path.read_text().count("\n@jit_quickly") for path in (ROOT / "experts").rglob("*.py")]
    assert len({program.function for program in quick}) == sum(decorated)
    for program in quick:
        arguments, settings = program.call()
        traced = program.function.program.trace(*arguments, **settings)
        rounding = {equation.primitive.name for equation in equations(traced.jaxpr) if of_floats(equation)}
        assert not rounding & {"mul", "dot_general", "exp", "log", "sin", "cos", "tanh", "erf_inv"}, program.name


@pytest.mark.slow
def test_programs_call_no_code_but_ours(programs: list[Program]) -> None:
    """LAPACK's factorisations wait for XLA's pool from within it, which is deadly where two workers share a process."""
    called = set[str]()
    for program in programs:
        program.prepare()
        for compiled in program.function._programs.values():
            called |= set(re.findall(r'custom_call_target="([^"]+)"', compiled.as_text()))
    assert called
    assert all(name.startswith(NAME) for name in called), called


def of_floats(equation: Any) -> bool:
    dtypes = (getattr(variable.aval, "dtype", None) for variable in equation.outvars)
    return any(dtype is not None and jnp.issubdtype(dtype, jnp.floating) for dtype in dtypes)


def equations(jaxpr: Any) -> Iterator[Any]:
    """Yield all equations, those of inner functions included."""
    for equation in jaxpr.eqns:
        yield equation
        for inner in jax.extend.core.jaxprs_in_params(equation.params):
            yield from equations(inner)
