"""The whole step has the same bits as machine code and as XLA operations."""

import json
import platform
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from levelproof.physics.step import step
from tests.pace import patience
from tests.physics.both_ways import digest, worlds

ROOT = Path(__file__).parents[2]


X86 = platform.machine() in ("x86_64", "AMD64")  # elsewhere nothing keeps XLA from contracting


def here(name: str):
    return jax.jit(lambda given: step(*given))(worlds(name))


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [
        ("6,3,2,0", "4,1,0,0"),  # two solver batches of a kind; no joints, no pairs of polygons or of circles
        pytest.param(("s", "m", "l", "5,0,0,0", "6,0,2,1", "6,3,0,1", "8,8,8,4"), marks=pytest.mark.campaign),
    ],
    ids=" ".join,
)
def test_machine_code_equals_xla_bit_for_bit(names: tuple[str, ...]) -> None:
    command = [sys.executable, "-m", "tests.physics.both_ways", *names]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=patience(600))
    assert done.returncode == 0, done.stderr[-2000:]
    for name, report in json.loads(done.stdout).items():
        assert report["touching"] > 0.1
        share = 1.0 if X86 else 0.0
        assert min(report["alike"].values()) >= share, (name, report["alike"])
        assert report["alike"]["State.contact_active"] >= 0.99
        assert report["digest"] == digest(here(name)), f"{name}: bits depend on XLA's flags"
