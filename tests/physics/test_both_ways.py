"""The whole step: machine code and XLA's operations make the same bits of the one source."""

import json
import platform
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from physics.step import step
from tests.physics.both_ways import digest, worlds

ROOT = Path(__file__).parents[2]


class TestStep:
    """The whole step: machine code and XLA's operations make the same bits of the one source."""

    X86 = platform.machine() in ("x86_64", "AMD64")  # elsewhere XLA cannot be kept from contracting

    @pytest.mark.parametrize(
        "name",
        [
            "s",
            *[
                pytest.param(name, marks=pytest.mark.slow)
                for name in ("m", "l", "6,0,2,1", "6,3,0,1", "6,3,2,0", "4,1,0,0", "5,0,0,0", "8,8,8,4")
            ],
        ],
    )
    def test_both_ways_are_one(self, name: str) -> None:
        command = [sys.executable, "-m", "tests.physics.both_ways", name]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, done.stderr[-2000:]
        said = json.loads(done.stdout)[name]
        assert said["touching"] > 0.1
        least = 1.0 if self.X86 else 0.0
        assert min(said["alike"].values()) >= least, said["alike"]
        assert said["alike"]["State.contact_active"] >= 0.99
        assert said["digest"] == digest(here(name)), "another process, under other flags of XLA, got other bits"


def here(name: str):
    return jax.jit(lambda given: step(*given))(worlds(name))
