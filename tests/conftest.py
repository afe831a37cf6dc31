"""One way to run JAX for all tests: as a worker does, with compiled code kept between tests and between runs.

And the reference's own environment, for the tests that compare with it.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest

from benchmarks import oracle
from pipeline.errors import Failure
from pipeline.runtime import CACHE_VARIABLE, prepare_jax

ROOT = Path(__file__).parent.parent
ASKED = "LEVELPROOF_TEST_ORACLE"
MOST_MAPS = 20_000

os.environ.setdefault(CACHE_VARIABLE, str(ROOT / ".pytest_cache" / "levelproof"))
prepare_jax()  # before any test touches JAX; commands that tests start inherit the folder


@pytest.fixture(autouse=True, scope="module")
def room_for_programs() -> Iterator[None]:
    """Forget compiled programs when there are many: each takes several memory maps, of which Linux gives a process
    65,530 and XLA crashes without another one. The cache folder brings back what is needed again."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()


@pytest.fixture(scope="session")
def reference() -> Path:
    """The Python of the reference's environment.

    Making it downloads a gigabyte and takes minutes, so the tests do it only when asked to.
    """
    there = (oracle.cache_folder() / "reference" / "ready").is_file()
    if not (there or os.environ.get(oracle.PYTHON_VARIABLE) or os.environ.get(ASKED)):
        pytest.skip(f"the reference's environment is not there: {ASKED}=1 makes it, {oracle.PYTHON_VARIABLE} names one")
    try:
        return oracle.oracle_python()
    except Failure as failure:
        pytest.skip(f"the reference's environment cannot be made: {failure}")
