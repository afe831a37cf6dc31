"""Machine code is made once, and what a disk did to it since is not executed."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import pytest

from physics.codegen.kept import kept

# A process that steps a world, and says how often it optimised a kernel and what came of the step
PROGRAM = """
import sys
import jax
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
from llvmlite import binding
emit, made = binding.TargetMachine.emit_object, []
binding.TargetMachine.emit_object = lambda self, module: made.append(module) or emit(self, module)
from tests.physics.test_machines import digest
result = digest("s")
print(len(made), result)
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
    assert (first[0], second[0]) == ("1", "0")
    assert first[1] == second[1]


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
