"""Machine code is compiled once and stored; a damaged file is not executed."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import pytest

from levelproof.physics.codegen import kept as module
from levelproof.physics.codegen.kept import cached, cached_by_sources
from tests.pace import patience

# A process that steps a world and prints how many kernels it wrote and optimised, and a digest of the step
PROGRAM = """
import sys
import jax
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
from llvmlite import binding
emit, made = binding.TargetMachine.emit_object, []
binding.TargetMachine.emit_object = lambda self, module: made.append(module) or emit(self, module)
from levelproof.physics.codegen import call, kept
kept.BEGAN = float("inf")  # a source may have been edited a moment ago
write, written = call.write, []
call.write = lambda *given: written.append(given) or write(*given)
from tests.physics.test_machines import digest
result = digest("s")
print(len(written), len(made), result)
"""
ROOT = Path(__file__).parents[3]


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    before = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


def made(code: bytes) -> tuple[Callable[[], bytes], list[bytes]]:
    calls: list[bytes] = []
    return lambda: calls.append(code) or code, calls


@pytest.mark.slow
def test_second_process_reuses_the_kernel_of_the_first(tmp_path: Path) -> None:
    command = [sys.executable, "-c", PROGRAM, str(tmp_path)]
    first, second = (
        subprocess.check_output(command, cwd=ROOT, text=True, timeout=patience(1800)).split() for _ in range(2)
    )
    assert (first[:2], second[:2]) == (["1", "1"], ["0", "0"])
    assert first[2] == second[2]


@pytest.mark.parametrize("damage", [lambda code: code[:-1], lambda code: b"", lambda code: code[:-1] + b"!"])
def test_cached_remakes_a_damaged_file(folder: Path, damage: Callable[[bytes], bytes]) -> None:
    assert cached("one", made(b"code")[0]) == b"code"
    (file,) = folder.iterdir()
    file.write_bytes(damage(file.read_bytes()))
    make, calls = made(b"code")
    assert [cached("one", make), cached("one", make)] == [b"code"] * 2
    assert len(calls) == 1
    assert list(folder.iterdir()) == [file]


def test_cached_stores_code_by_key(folder: Path) -> None:
    assert [cached(name, made(name.encode())[0]) for name in ("one", "two", "one")] == [b"one", b"two", b"one"]
    assert len(list(folder.iterdir())) == 2


def test_cached_works_without_a_folder(folder: Path) -> None:
    jax.config.update("jax_compilation_cache_dir", str(folder / "gone"))
    make, calls = made(b"code")
    assert [cached("one", make), cached("one", make)] == [b"code"] * 2
    assert len(calls) == 2


@pytest.fixture
def source(folder: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Replace the kernels' sources by one file; this process begins an hour later."""
    path = tmp_path_factory.mktemp("sources") / "one.py"
    path.write_text("source")
    monkeypatch.setattr(module, "BEGAN", time.time() + 3600)
    module._sources.cache_clear()
    yield path
    module._sources.cache_clear()


def changed(source: Path, text: str) -> None:
    source.write_text(text)
    module._sources.cache_clear()


def test_cached_notices_changed_sources(source: Path) -> None:
    make, calls = made(b"code")
    for text, so_far in (("source", 1), ("source", 1), ("other", 2), ("source", 2)):
        changed(source, text)
        assert cached_by_sources("one", make, [source.parent]) == b"code"
        assert len(calls) == so_far
    source.rename(source.with_name("two.py"))
    module._sources.cache_clear()
    cached_by_sources("one", make, [source.parent])
    cached_by_sources("two", make, [source.parent])
    assert len(calls) == 4


def test_cached_stores_nothing_if_a_source_changed_since_the_start(
    source: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process may still run the previous version, also of a copy that keeps its original's time of change."""
    make, calls = made(b"code")
    monkeypatch.setattr(module, "BEGAN", source.stat().st_ctime)
    os.utime(source, (0, 0))
    module._sources.cache_clear()
    assert [cached_by_sources("one", make, [source.parent]) for _ in range(2)] == [b"code"] * 2
    assert len(calls) == 2
    assert not list(folder.iterdir())
