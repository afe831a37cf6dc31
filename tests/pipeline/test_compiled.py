"""Half-written compiled programs are deleted, recompiled once, and then kept."""

import os
import time
import zlib
from pathlib import Path

import pytest
from jax._src.compilation_cache import compress_executable

from levelproof.pipeline.runtime import LAST_CHECK, remove_damaged
from tests.pipeline.test_runtime import python

COMPILE = """
from levelproof.pipeline.runtime import prepare_jax
prepare_jax()
import warnings
warnings.simplefilter("error")  # JAX warns of programs that it cannot read
import jax
jax.jit(lambda x: x @ x + 1)(jax.numpy.ones((8, 8)))
"""


def programs(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("*-cache")}


@pytest.mark.slow
def test_truncated_program_is_recompiled_without_a_warning(tmp_path: Path) -> None:
    folder = tmp_path / "jax"
    python(COMPILE, tmp_path)
    whole = programs(folder)
    remove_damaged(folder)
    assert programs(folder) == whole
    for name, content in whole.items():
        (folder / name).write_bytes(content[: len(content) // 2])
    python(COMPILE, tmp_path)
    again = programs(folder)
    assert again.keys() == whole.keys()
    assert all(len(again[name]) > len(whole[name]) // 2 for name in whole)
    remove_damaged(folder)
    assert programs(folder) == again


def test_remove_damaged_keeps_programs_that_another_library_compressed(tmp_path: Path) -> None:
    """Environments with and without zstandard share the folder."""
    is_zlib = compress_executable(b"")[:1] == b"\x78"
    other = b"\x28\xb5\x2f\xfd" if is_zlib else zlib.compress(b"program")
    for name, content in {"theirs": other, "ours": compress_executable(b"program")[:5]}.items():
        (tmp_path / f"{name}-cache").write_bytes(content)
    remove_damaged(tmp_path)
    assert programs(tmp_path) == {"theirs-cache": other}


def test_remove_damaged_deletes_what_killed_processes_were_writing(tmp_path: Path) -> None:
    names = ".levelproof-1.kernel.7.8", ".levelproof-2.kernel.7.8", "levelproof-3.kernel"
    old, new, whole = (tmp_path / name for name in names)
    for path in old, new, whole:
        path.write_bytes(b"")
    for path in old, whole:
        os.utime(path, (0, 0))
    remove_damaged(tmp_path)
    assert (old.exists(), new.exists(), whole.exists()) == (False, True, True)


def test_remove_damaged_reads_programs_that_changed_since_the_last_check(tmp_path: Path) -> None:
    program, last_check = tmp_path / "jit_f-0-cache", tmp_path / LAST_CHECK
    program.write_bytes(b"damaged")
    remove_damaged(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [LAST_CHECK]
    program.write_bytes(b"damaged")
    os.utime(program, (0, 0))  # a copy that keeps the time of its original
    later = time.time() + 60
    os.utime(last_check, (later, later))
    remove_damaged(tmp_path)
    assert program.exists()  # unchanged since the last check
    remove_damaged(tmp_path)
    assert not program.exists()
