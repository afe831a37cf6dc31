"""The whole step: machine code and XLA's operations make the same bits of the one source."""

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


X86 = platform.machine() in ("x86_64", "AMD64")  # elsewhere XLA cannot be kept from contracting


def here(name: str):
    return jax.jit(lambda given: step(*given))(worlds(name))


@pytest.mark.parametrize(
    "names",
    [
        ("6,3,2,0", "4,1,0,0"),  # two solver batches of a kind; nothing joined, no pairs of polygons or circles
        pytest.param(("s", "m", "l", "5,0,0,0", "6,0,2,1", "6,3,0,1", "8,8,8,4"), marks=pytest.mark.campaign),
    ],
    ids=" ".join,
)
def test_both_ways_are_one(names: tuple[str, ...]) -> None:
    command = [sys.executable, "-m", "tests.physics.both_ways", *names]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=patience(600))
    assert done.returncode == 0, done.stderr[-2000:]
    for name, said in json.loads(done.stdout).items():
        assert said["touching"] > 0.1
        least = 1.0 if X86 else 0.0
        assert min(said["alike"].values()) >= least, (name, said["alike"])
        assert said["alike"]["State.contact_active"] >= 0.99
        assert said["digest"] == digest(here(name)), f"{name}: another process, under other flags of XLA: other bits"
