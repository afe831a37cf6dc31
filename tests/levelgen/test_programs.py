"""Programs that one process stores and others load: found by what decides them, and made again if damaged."""

import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import monitoring
from jax.experimental.compilation_cache import compilation_cache

from levelproof.levelgen import programs
from levelproof.levelgen.programs import LOADED, StoredProgram, jit_stored
from levelproof.levelgen.proofs import examine
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES
from levelproof.physics.codegen import kept
from tests.pace import patience

SCRIPT = """
from levelproof.pipeline.runtime import prepare_jax
prepare_jax()
from jax import monitoring
import numpy as np
events = []
note = lambda event, seconds, fun_name="", **_: events.append((event, fun_name))
monitoring.register_event_duration_secs_listener(note)
from levelproof.levelgen.programs import LOADED
from levelproof.levelgen.proofs import examine
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES
facts = examine(sample_levels(np.arange(16), "s"), DEFAULT_RULES, 8)
names = [name for _, name in events if name in ("examine", "sample_chunk")]
print(len(names), sum(event == LOADED for event, _ in events))
print(np.asarray(facts).tobytes().hex())
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty folder for stored programs and for JAX's own."""
    monkeypatch.setattr(kept, "BEGAN", float("inf"))  # a source may have been checked out or edited a moment ago
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    compilation_cache.reset_cache()
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)
    compilation_cache.reset_cache()


def plain(x: jax.Array, times: int) -> dict[str, jax.Array]:
    return {"sum": (x * times).sum(), "all": x + times}


def copy_of(function=plain, **settings) -> StoredProgram:
    """Return the same program as another process would have it: not made yet, and unknown to JAX."""
    jax.clear_caches()
    return jit_stored(static_argnames="times", **settings)(function)


def loads() -> list[str]:
    events: list[str] = []
    monitoring.register_event_duration_secs_listener(
        lambda event, seconds, **_: events.append(event) if event == LOADED else None
    )
    return events


def in_process(cache: Path) -> tuple[int, int, str]:
    """Run the program in a new process; return how often it was traced and loaded, and the result."""
    environment = {"PATH": "/usr/bin:/bin", "LEVELPROOF_CACHE_DIR": str(cache)}
    command = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(
        command, capture_output=True, text=True, env=environment, cwd=Path(__file__).parents[2], timeout=patience(1800)
    )
    assert not done.returncode, done.stderr
    traced, loaded, result = done.stdout.split()
    return int(traced), int(loaded), result


@pytest.mark.slow
def test_another_process_neither_traces_nor_compiles(tmp_path: Path) -> None:
    traced, loaded, result = in_process(tmp_path / "cache")
    assert traced
    assert not loaded
    assert in_process(tmp_path / "cache") == (0, 2, result)


@pytest.mark.campaign
def test_program_of_jax_cache_is_not_stored(tmp_path: Path) -> None:
    """XLA would store it without some of its functions, and whoever loaded it would fail."""
    cache = tmp_path / "cache"
    traced, _, result = in_process(cache)
    for file in (cache / "jax").glob("*.kernel"):
        file.unlink()
    assert in_process(cache) == in_process(cache) == (traced, 0, result)


def test_program_is_loaded_once_and_for_its_types_only(folder: Path) -> None:
    x, loaded = jnp.arange(4.0), loads()
    expected = plain(x, 3)
    made = copy_of()
    for _ in range(2):
        jax.tree.map(np.testing.assert_array_equal, made(x, times=3), expected)
    assert made.count() == 1
    assert len(list(folder.glob("*.kernel"))) == 2, "the program, and the file that names it"
    assert not loaded
    other = copy_of()
    jax.tree.map(np.testing.assert_array_equal, other(np.arange(4, dtype=np.float32), 3), expected)
    assert len(loaded) == other.count() == 1
    for arguments in ((x, 4), (jnp.arange(5.0), 3), (jnp.arange(4), 3)):
        other(*arguments)
    assert other.count() == 4
    assert len(list(folder.glob("*.kernel"))) == 8
    assert len(loaded) == 1


@pytest.mark.parametrize("damage", [b"", b"x" * 200])
def test_damaged_program_is_made_again(damage: bytes, folder: Path) -> None:
    x, loaded = jnp.arange(4.0), loads()
    copy_of()(x, 3)
    for file in folder.glob("*.kernel"):
        file.write_bytes(damage)
    for file in folder.glob("*-cache"):  # what JAX reads from its own cache is not stored again
        file.unlink()
    assert float(copy_of()(x, 3)["sum"]) == 18
    assert not loaded
    assert float(copy_of()(x, 3)["sum"]) == 18
    assert len(loaded) == 1, "the damaged file was replaced"


def test_shapes_of_arguments_that_nothing_reads_count(folder: Path) -> None:
    """Levels of another size may differ only in fields that a program ignores."""
    program = jit_stored()(lambda x, ignored: 2 * x)
    for width in (3, 4):
        assert float(program(jnp.float32(1), jnp.zeros(width))) == 2


def test_program_that_jax_has_compiled_in_another_thread_is_not_stored(folder: Path) -> None:
    """JAX hands it over without a word, and it may come from JAX's cache, so that XLA would not store it whole."""
    copies = [copy_of(), jit_stored(static_argnames="times")(plain)]
    copies[0](jnp.arange(4.0), 3)
    stored = {*folder.glob("*.kernel")}
    for file in stored:
        file.unlink()
    assert float(copies[1](jnp.arange(4.0), 3)["sum"]) == 18
    assert not list(folder.glob("*.kernel"))


def test_threads_make_a_program_once(folder: Path) -> None:
    traced: list[int] = []

    def traces(x: jax.Array) -> jax.Array:
        traced.append(1)
        return 2 * x

    program = jit_stored()(traces)
    with ThreadPoolExecutor(4) as threads:
        assert [float(two) for two in threads.map(program, [np.float32(1)] * 4)] == [2.0] * 4
    assert len(traced) == program.count() == 1


def test_argument_without_a_text_of_its_own_is_not_stored(folder: Path) -> None:
    assert float(copy_of(lambda x, times: times(x))(jnp.float32(2), lambda x: x * 2)) == 4
    assert not list(folder.glob("*.kernel"))


def test_loaded_program_takes_what_is_donated(folder: Path) -> None:
    copy_of(donate_argnames="x")(jnp.arange(4.0), 3)
    x = jnp.arange(4.0)
    assert copy_of(donate_argnames="x")(x, 3)["all"].tolist() == [3, 4, 5, 6]
    assert x.is_deleted()


@pytest.mark.slow
def test_stored_program_can_be_part_of_another() -> None:
    levels = sample_levels(np.arange(16), "s")
    alone = examine(levels, DEFAULT_RULES, 8)
    within = jax.jit(lambda levels: examine(levels, DEFAULT_RULES, 8))(levels)
    jax.tree.map(np.testing.assert_array_equal, within, alone)


def test_program_is_a_part_of_a_program_that_calls_it(folder: Path) -> None:
    """Whether JAX traces its arguments or not; a part has no options of its own."""
    made = copy_of()
    outer = jax.jit(lambda x: made(x, 3)["sum"] + made(np.arange(3.0, dtype=np.float32), 3)["sum"])
    assert float(outer(jnp.arange(4.0))) == 18 + 9
    assert not made._programs


def test_most_optimisations_can_be_switched_off(folder: Path) -> None:
    made = copy_of()
    assert made.options["xla_backend_optimization_level"] == 1
    results = [made(jnp.arange(4.0), 3)]
    jax.config.update("jax_disable_most_optimizations", True)
    try:
        assert made.options["xla_backend_optimization_level"] == 0
        results.append(made(jnp.arange(4.0), 3))
    finally:
        jax.config.update("jax_disable_most_optimizations", False)
    assert made.count() == 2
    jax.tree.map(np.testing.assert_array_equal, *results)


def test_present_settings_are_part_of_a_programs_key(monkeypatch: pytest.MonkeyPatch) -> None:
    before = programs.machine()
    jax.config.update("jax_default_matmul_precision", "highest")
    try:
        assert programs.machine() != before
    finally:
        jax.config.update("jax_default_matmul_precision", None)
    assert programs.machine() == before
