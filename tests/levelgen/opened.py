"""Level files opened by the reference, in its own environment (`benchmarks/reference/levels.py` runs there)."""

import subprocess
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks import oracle
from levelproof.levelgen.files.kinetix import Fields, level_from_kinetix
from levelproof.levelgen.level import Level
from tests.pace import patience


def handmade_levels(python: Path) -> Path:
    """Return the folder of level files in the reference's installation."""
    code = "from importlib.util import find_spec; print(find_spec('kinetix').origin)"
    ran = subprocess.run(
        [python, "-c", code],
        env=oracle.environment(),
        capture_output=True,
        text=True,
        check=True,
        timeout=patience(1800),
    )
    return Path(ran.stdout.strip()).parent / "levels"


class Played(NamedTuple):
    """Files as the reference opened and played them."""

    files: list[Path]
    arrays: dict[str, np.ndarray]

    def states(self) -> Fields:
        """Return the states under the reference's names, (step, level, ...)."""
        return {
            name.removeprefix("state/"): values for name, values in self.arrays.items() if name.startswith("state/")
        }

    def levels(self) -> Level:
        """Return the levels as the reference opened them."""
        return level_from_kinetix({name: values[0] for name, values in self.states().items()})


def open_in_reference(python: Path, files: list[Path], out: Path, steps: int = 0) -> Played:
    environment = dict(oracle.environment()) | {
        "JAX_COMPILATION_CACHE_DIR": str(oracle.cache_folder() / "reference-jax"),
    }
    command = [python, oracle.SCRIPTS / "levels.py", out, str(steps), *files]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=patience(1800))
    assert done.returncode == 0, done.stderr[-2000:]
    with np.load(out) as arrays:
        return Played(files, dict(arrays))
