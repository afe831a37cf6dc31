"""The reference's own environment: Kinetix 3.0.2, made on first use in the user's cache folder."""

import fcntl
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.runtime import cache_folder

PYTHON_VARIABLE = "LEVELPROOF_ORACLE_PYTHON"  # a Python that has the reference already
REQUIREMENTS = ("kinetix-env==3.0.2", "jax2d==1.0.1", "jax[cpu]==0.9.0")
LEVELS = 1024  # sampled per size and kept; more lanes go round
SEED = 0
ROOT = Path(__file__).parent.parent
SCRIPTS = Path(__file__).parent / "reference"


def oracle_python() -> Path:
    """The Python that runs the reference, made if need be (about two minutes, a gigabyte).

    Raises:
        UserError: LEVELPROOF_ORACLE_PYTHON names no program.
        Failure: it cannot be made.
    """
    if chosen := os.environ.get(PYTHON_VARIABLE):
        if shutil.which(chosen) is None:
            raise UserError(f"{PYTHON_VARIABLE} is {chosen}, which is no program: unset it, or name a Python.")
        return Path(chosen)
    folder = cache_folder() / "reference"
    python, ready = folder / "bin" / "python", folder / "ready"
    with alone(cache_folder() / "reference.lock"):
        if not ready.is_file() or ready.read_text() != "\n".join(REQUIREMENTS):
            _make(folder)
            ready.write_text("\n".join(REQUIREMENTS))
    return python


def handmade_levels(python: Path) -> Path:
    """The folder of the reference's handmade levels, in its installation."""
    code = "from importlib.util import find_spec; print(*find_spec('kinetix').submodule_search_locations)"
    return Path(_run([python, "-c", code], "find the reference's handmade levels", environment()).strip()) / "levels"


def sampled_levels(python: Path, size: str, count: int = LEVELS, seed: int = SEED) -> Path:
    """A file of levels that the reference sampled, made on first use (minutes: it compiles slowly)."""
    path = cache_folder() / "bench" / f"levels-{size}-{count}-{seed}.npz"
    with alone(cache_folder() / "bench.lock"):
        if not path.is_file():
            log(f"Sampling {count} levels of size {size} with the reference (once, one to three minutes) ...")
            path.parent.mkdir(parents=True, exist_ok=True)
            unfinished = path.with_name(f"unfinished-{path.name}")
            words = [unfinished, "--size", size, "--count", count, "--seed", seed]
            run_script(python, "world", words, "sample levels with the reference")
            unfinished.replace(path)
    return path


def run_script(python: Path, script: str, words: Sequence[object], what: str) -> str:
    """What a script of benchmarks/reference prints in the reference's interpreter.

    Raises:
        Failure: it fails; `what` says at what.
    """
    return _run([python, SCRIPTS / f"{script}.py", *words], what, environment())


def run_ours(script: str, words: Sequence[object]) -> str:
    """What a script of benchmarks/ours prints, in a process of its own.

    Raises:
        Failure: it fails.
    """
    return _run([sys.executable, "-m", f"benchmarks.ours.{script}", *words], f"run our {script}", our_environment())


def versions(python: Path) -> dict[str, str]:
    """Versions of the reference and of what it runs on."""
    names = ("kinetix-env", "jax2d", "jax", "jaxlib")
    code = f"from importlib.metadata import version; print(*(version(name) for name in {names!r}))"
    told = _run([python, "-c", code], "ask the reference for its version", environment()).split()
    return dict(zip(names, told, strict=True))


def environment() -> Mapping[str, str]:
    """Of the reference's processes: nothing of ours, no compiled code kept."""
    ours = ("PYTHONPATH", "PYTHONHOME", "JAX_COMPILATION_CACHE_DIR", "XLA_FLAGS")
    return {name: value for name, value in os.environ.items() if name not in ours} | {"JAX_PLATFORMS": "cpu"}


def our_environment() -> Mapping[str, str]:
    """Of our processes: they find the packages wherever they were imported from."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    return dict(os.environ) | {"PYTHONPATH": path, "JAX_PLATFORMS": "cpu"}


def log(text: str) -> None:
    """To the person who waits; standard output is for results."""
    print(text, file=sys.stderr, flush=True)


def _make(folder: Path) -> None:
    log(f"Making the reference's environment in {folder} (once, about two minutes) ...")
    shutil.rmtree(folder, ignore_errors=True)
    _run([sys.executable, "-m", "venv", folder], "make an environment for the reference", environment())
    pip = [folder / "bin" / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    hint = f"check the network, or set {PYTHON_VARIABLE} to a Python that has {REQUIREMENTS[0]}"
    _run([*pip, *REQUIREMENTS], f"install {REQUIREMENTS[0]}", environment(), hint)


def _run(command: Sequence[object], what: str, environment: Mapping[str, str], hint: str = "") -> str:
    words = [str(word) for word in command]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise Failure(f"Cannot {what} ({reason})" + (f": {hint}." if hint else "."))
    return done.stdout


@contextmanager
def alone(path: Path) -> Iterator[None]:
    """One process at a time; the others wait."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a")
    except OSError as error:
        raise Failure(
            f"Cannot write to the cache folder {path.parent} ({error.strerror}): set LEVELPROOF_CACHE_DIR to another."
        ) from None
    with file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
