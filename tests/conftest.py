"""One way to run JAX for all tests: as a worker does, with compiled code kept between tests and between runs."""

import os
from pathlib import Path

from pipeline.runtime import CACHE_VARIABLE, prepare_jax

ROOT = Path(__file__).parent.parent

os.environ.setdefault(CACHE_VARIABLE, str(ROOT / ".pytest_cache" / "levelproof"))
prepare_jax()  # before any test touches JAX; commands that tests start inherit the folder
