"""Machine code is made once, and what a disk did to it since is not executed."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import pytest

from levelproof.physics.codegen import kept as module
from levelproof.physics.codegen.kept import kept, kept_while_sources_stay

# A process that steps a world, and says how often it wrote a kernel, and optimised one, and what came of the step
PROGRAM = """
import sys
import jax
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
from llvmlite import binding
emit, made = binding.TargetMachine.emit_object, []
binding.TargetMachine.emit_object = lambda self, module: made.append(module) or emit(self, module)
from levelproof.physics import step
from levelproof.physics.codegen import kept
kept.BEGAN = float("inf")  # whoever runs this may have changed a source a moment ago
write, written = step.write, []
step.write = lambda *given: written.append(given) or write(*given)
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


def test_another_process_executes_what_the_first_made(tmp_path: Path) -> None:
    command = [sys.executable, "-c", PROGRAM, str(tmp_path)]
    first, second = (subprocess.check_output(command, cwd=ROOT, text=True).split() for _ in range(2))
    assert (first[:2], second[:2]) == (["1", "1"], ["0", "0"])
    assert first[2] == second[2]


@pytest.mark.parametrize("damage", [lambda code: code[:-1], lambda code: b"", lambda code: code[:-1] + b"!"])
def test_what_is_damaged_is_made_again(folder: Path, damage: Callable[[bytes], bytes]) -> None:
    assert kept("one", made(b"code")[0]) == b"code"
    (file,) = folder.iterdir()
    file.write_bytes(damage(file.read_bytes()))
    make, calls = made(b"code")
    assert [kept("one", make), kept("one", make)] == [b"code"] * 2
    assert len(calls) == 1
    assert list(folder.iterdir()) == [file]


def test_another_key_is_other_code(folder: Path) -> None:
    assert [kept(name, made(name.encode())[0]) for name in ("one", "two", "one")] == [b"one", b"two", b"one"]
    assert len(list(folder.iterdir())) == 2


def test_a_folder_that_is_none_costs_time_and_nothing_else(folder: Path) -> None:
    jax.config.update("jax_compilation_cache_dir", str(folder / "gone"))
    make, calls = made(b"code")
    assert [kept("one", make), kept("one", make)] == [b"code"] * 2
    assert len(calls) == 2


@pytest.fixture
def source(folder: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The only one that kernels come from; written long before this process began."""
    path = tmp_path_factory.mktemp("sources") / "one.py"
    path.write_text("source")
    os.utime(path, (0, 0))
    monkeypatch.setattr(module, "SOURCES", path.parent)
    module._sources.cache_clear()
    yield path
    module._sources.cache_clear()


def changed(source: Path, text: str, when: float) -> None:
    source.write_text(text)
    os.utime(source, (when, when))
    module._sources.cache_clear()


def test_other_sources_make_other_code(source: Path) -> None:
    make, calls = made(b"code")
    for text, so_far in (("source", 1), ("source", 1), ("other", 2), ("source", 2)):
        changed(source, text, 0)
        assert kept_while_sources_stay("one", make) == b"code"
        assert len(calls) == so_far
    source.rename(source.with_name("two.py"))
    module._sources.cache_clear()
    kept_while_sources_stay("one", make)
    kept_while_sources_stay("two", make)
    assert len(calls) == 4


def test_of_sources_that_have_changed_since_the_process_began_nothing_is_kept(source: Path, folder: Path) -> None:
    """It may still run the former ones."""
    make, calls = made(b"code")
    changed(source, "source", module.BEGAN + 1)
    assert [kept_while_sources_stay("one", make) for _ in range(2)] == [b"code"] * 2
    assert len(calls) == 2
    assert not list(folder.iterdir())
