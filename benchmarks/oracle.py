"""The reference's own Python environment: Kinetix 3.0.2, made on first use in the user's cache folder."""

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

PYTHON_VARIABLE = "LEVELPROOF_ORACLE_PYTHON"  # names a Python that already has the reference
REQUIREMENTS = ("kinetix-env==3.0.2", "jax2d==1.0.1", "jax[cpu]==0.9.0")
LEVELS = 1024  # sampled and cached per size; more lanes reuse them in order
SEED = 0
ROOT = Path(__file__).parent.parent
SCRIPTS = Path(__file__).parent / "reference"


def oracle_python() -> Path:
    """Return the Python that runs the reference, made on first use (about two minutes, a gigabyte).

    Raises:
        UserError: LEVELPROOF_ORACLE_PYTHON names no program.
        Failure: the environment cannot be made.
    """
    if chosen := os.environ.get(PYTHON_VARIABLE):
        if shutil.which(chosen) is None:
            raise UserError(f"{PYTHON_VARIABLE} is {chosen}, which is not a program: unset it, or name a Python.")
        return Path(chosen)
    folder = cache_folder() / "reference"
    python, ready = folder / "bin" / "python", folder / "ready"
    with alone(cache_folder() / "reference.lock"):
        if not ready.is_file() or ready.read_text() != "\n".join(REQUIREMENTS):
            _make(folder)
            ready.write_text("\n".join(REQUIREMENTS))
    return python


def handmade_levels(python: Path) -> Path:
    """Return the folder of handmade levels in the reference's installation."""
    code = "from importlib.util import find_spec; print(*find_spec('kinetix').submodule_search_locations)"
    return Path(_run([python, "-c", code], "find the reference's handmade levels", environment()).strip()) / "levels"


def sampled_levels(python: Path, size: str, count: int = LEVELS, seed: int = SEED) -> Path:
    """Return a file of levels that the reference sampled, made on first use (minutes: it compiles slowly)."""
    path = cache_folder() / "bench" / f"levels-{size}-{count}-{seed}.npz"
    with alone(cache_folder() / "bench.lock"):
        if not path.is_file():
            log(f"Sampling {count} levels of size {size} with the reference (once, one to three minutes) ...")
            path.parent.mkdir(parents=True, exist_ok=True)
            unfinished = path.with_name(f"unfinished-{path.name}")
            arguments = [unfinished, "--size", size, "--count", count, "--seed", seed]
            run_script(python, "world", arguments, "sample levels with the reference")
            unfinished.replace(path)
    return path


def run_script(python: Path, script: str, arguments: Sequence[object], task: str) -> str:
    """Run a script of benchmarks/reference in the reference's interpreter; return what it prints.

    Raises:
        Failure: the script fails; `task` completes "Cannot ..." in the message.
    """
    return _run([python, SCRIPTS / f"{script}.py", *arguments], task, environment())


def run_ours(script: str, arguments: Sequence[object]) -> str:
    """Run a script of benchmarks/ours in its own process; return what it prints.

    Raises:
        Failure: the script fails.
    """
    return _run([sys.executable, "-m", f"benchmarks.ours.{script}", *arguments], f"run our {script}", our_environment())


def run_levelproof(*arguments: object) -> str:
    """Run `levelproof` in its own process; return what it prints.

    Raises:
        Failure: the command fails.
    """
    return _run([sys.executable, "-m", "levelproof", *arguments], f"run levelproof {arguments[0]}", our_environment())


def versions(python: Path) -> dict[str, str]:
    """Return the versions of the reference and of its dependencies."""
    names = ("kinetix-env", "jax2d", "jax", "jaxlib")
    code = f"from importlib.metadata import version; print(*(version(name) for name in {names!r}))"
    printed = _run([python, "-c", code], "ask the reference for its version", environment()).split()
    return dict(zip(names, printed, strict=True))


def environment() -> Mapping[str, str]:
    """Return environment variables for the reference's processes: none of ours, no compilation cache."""
    ours = ("PYTHONPATH", "PYTHONHOME", "JAX_COMPILATION_CACHE_DIR", "XLA_FLAGS")
    return {name: value for name, value in os.environ.items() if name not in ours} | {"JAX_PLATFORMS": "cpu"}


def our_environment() -> Mapping[str, str]:
    """Return environment variables for our processes: they import the same packages as this one."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    return dict(os.environ) | {"PYTHONPATH": path, "JAX_PLATFORMS": "cpu"}


def log(text: str) -> None:
    """Print progress to standard error; standard output is for results."""
    print(text, file=sys.stderr, flush=True)


def _make(folder: Path) -> None:
    log(f"Making the reference's environment in {folder} (once, about two minutes) ...")
    shutil.rmtree(folder, ignore_errors=True)
    _run([sys.executable, "-m", "venv", folder], "make an environment for the reference", environment())
    pip = [folder / "bin" / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    hint = f"check the network, or set {PYTHON_VARIABLE} to a Python that has {REQUIREMENTS[0]}"
    _run([*pip, *REQUIREMENTS], f"install {REQUIREMENTS[0]}", environment(), hint)


def _run(command: Sequence[object], task: str, environment: Mapping[str, str], hint: str = "") -> str:
    arguments = [str(argument) for argument in command]
    done = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no message"])[-1].removeprefix("Error: ")
        raise Failure(f"Cannot {task} ({reason})" + (f": {hint}." if hint else "."))
    return done.stdout


@contextmanager
def alone(path: Path) -> Iterator[None]:
    """Hold the lock file in the `with` block, so that one process at a time runs it."""
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
