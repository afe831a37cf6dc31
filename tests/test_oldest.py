"""Levels and records keep their bits under the oldest JAX that pyproject.toml allows; CI installs the newest."""

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from levelproof.levelgen.sampling.sampler import CHUNK
from tests.conftest import REQUIRE_ORACLE
from tests.experts.witness.bits import FILE
from tests.golden import make_levels
from tests.pace import patience
from tests.processors import OWN, ROOT, run_on

pytestmark = pytest.mark.campaign
SIZES = ["s/kinetix", "m/kinetix", "l/kinetix"]


@pytest.fixture(scope="module")
def oldest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make an environment with the oldest JAX; return its Python. Skip the tests if the index cannot be reached."""
    requirements = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    (lowest,) = [match[1] for text in requirements if (match := re.fullmatch(r"jax>=([0-9.]+),<[0-9.]+", text))]
    folder = tmp_path_factory.mktemp("oldest")
    subprocess.run([sys.executable, "-m", "venv", folder], check=True, timeout=patience(1800))
    python = folder / "bin" / "python"
    wanted = ROOT, "pytest", f"jax=={lowest}.0", f"jaxlib=={lowest}.0"
    install = [python, "-m", "pip", "install", "-q", *wanted]
    installed = subprocess.run(install, capture_output=True, text=True, timeout=patience(1800))
    if installed.returncode and REQUIRE_ORACLE not in os.environ:
        pytest.skip(f"the oldest JAX cannot be installed: {installed.stderr[-500:]}")
    assert not installed.returncode, installed.stderr
    return python


def test_levels_have_their_golden_bits_under_the_oldest_jax(oldest: Path) -> None:
    golden = json.loads(make_levels.FILE.read_text())
    made = json.loads(run_on(OWN, "tests.levelgen.sampling.bits", str(CHUNK), *SIZES, python=oldest))
    assert made == {name: golden[name][:1] for name in SIZES}


def test_witnesses_give_their_golden_records_under_the_oldest_jax(oldest: Path) -> None:
    made = json.loads(run_on(OWN, "tests.experts.witness.bits", python=oldest))
    assert made == np.load(FILE)["digest"].tolist()
