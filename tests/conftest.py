"""One way to run JAX for all tests: as a worker does, with compiled code kept between tests and between runs.

And the reference's own environment, for the tests that compare with it.
"""

import os
from pathlib import Path

import pytest

from pipeline.bench import oracle
from pipeline.errors import Failure
from pipeline.runtime import CACHE_VARIABLE, prepare_jax

ROOT = Path(__file__).parent.parent
ASKED = "LEVELPROOF_TEST_ORACLE"

os.environ.setdefault(CACHE_VARIABLE, str(ROOT / ".pytest_cache" / "levelproof"))
prepare_jax()  # before any test touches JAX; commands that tests start inherit the folder


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
