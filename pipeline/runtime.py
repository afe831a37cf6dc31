"""How JAX computes in a process that runs work units: one thread, and compiled code kept for the next process.

Called before JAX starts its backend; changes nothing after that.
"""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from loky import cpu_count

from pipeline.compiled import remove_damaged

CACHE_VARIABLE = "LEVELPROOF_CACHE_DIR"
# One process per core, each with one thread, is twice as fast as one process with XLA's own threads; and a sum
# that is split over threads would make a level's bits depend on the machine's number of cores.
XLA_FLAGS = (
    "--xla_cpu_multi_thread_eigen=false",
    "--xla_cpu_prefer_vector_width=512",  # where the processor has it
)
# NPROC and PJRT_NPROC size XLA's pool; the others are those of numpy's libraries.
THREADS = ("NPROC", "PJRT_NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
MIN_COMPILE_SECONDS = 0.2  # what compiles faster is not worth a file


def cache_folder() -> Path:
    """Where compiled code is kept: LEVELPROOF_CACHE_DIR, else the user's cache folder."""
    if chosen := os.environ.get(CACHE_VARIABLE):
        return Path(chosen).expanduser()
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "levelproof"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "levelproof"


def prepare_jax(core: int | None = None) -> None:
    """Set this process up to run work units, on one CPU core or, with None, where the system likes."""
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = " ".join([flags, *(flag for flag in XLA_FLAGS if flag not in flags)]).strip()
    os.environ.update(dict.fromkeys(THREADS, "1"))
    if core is not None and sys.platform == "linux":  # no other system can
        for thread in os.listdir("/proc/self/task"):  # all of this process; those yet to come follow them
            os.sched_setaffinity(int(thread), {core})
    import jax  # reads the environment above

    programs = cache_folder() / "jax"
    remove_damaged(programs)
    jax.config.update("jax_compilation_cache_dir", str(programs))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", MIN_COMPILE_SECONDS)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


@contextmanager
def interruptible() -> Iterator[None]:
    """SIGTERM (a batch system's time limit) stops a job as Ctrl-C does."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def own_cores() -> list[int]:
    """The CPU cores that this process may keep busy: a container's quota may be smaller than their number."""
    return _allowed_cores()[: cpu_count()]


def cores_for(workers: int) -> list[int | None]:
    """The core that each worker stays on, for at most so many workers.

    None leaves that to the system, where not every core has a worker: two runs side by side would choose the same.
    """
    cores = own_cores()[:workers]
    return [*cores] if cores == _allowed_cores() else [None] * len(cores)


def _allowed_cores() -> list[int]:
    if sys.platform == "linux":
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))
