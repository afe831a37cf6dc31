"""How JAX computes in a process that runs work units: one thread, and compiled code kept for the next process.

Called before JAX starts its backend; changes nothing after that.
"""

import os
import socket
import sys
import time
from pathlib import Path
from typing import Literal

from loky import cpu_count

from levelproof.pipeline.compiled import remove_damaged
from levelproof.pipeline.owned import own_folder

CACHE_VARIABLE = "LEVELPROOF_CACHE_DIR"
# One process per core, each with one thread, is twice as fast as one process with XLA's own threads; and a sum
# that is split over threads would make a level's bits depend on the machine's number of cores.
XLA_FLAGS = (
    "--xla_cpu_multi_thread_eigen=false",
    "--xla_cpu_prefer_vector_width=512",  # where the processor has it
)
# NPROC and PJRT_NPROC size XLA's pool; the others are those of numpy's libraries.
THREADS = ("NPROC", "PJRT_NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
NO_GPU = "JAX cannot use one here, as it can with levelproof's extra `gpu`"
CLAIMING = 2.0  # s of trying to get a core
CLAIMS: list[socket.socket] = []  # of this process
# Settings of JAX that change results or refuse the code, by a user's environment variables or configuration
SETTLED = {
    "jax_enable_x64": False,
    "jax_default_matmul_precision": None,
    "jax_numpy_dtype_promotion": "standard",
    "jax_numpy_rank_promotion": "allow",
    "jax_disable_jit": False,
    "jax_debug_nans": False,  # worlds that break down have NaNs
    "jax_debug_infs": False,
}
MIN_COMPILE_SECONDS = 0.2  # what compiles faster is not worth a file


def cache_folder() -> Path:
    """Where compiled code is kept: LEVELPROOF_CACHE_DIR, else the user's cache folder.

    Raises:
        UserError: other users can write to it; JAX executes what it finds there.
    """
    if chosen := os.environ.get(CACHE_VARIABLE):
        path = Path(chosen).expanduser()
    elif sys.platform == "darwin":
        path = Path.home() / "Library" / "Caches" / "levelproof"
    else:
        path = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "levelproof"
    return own_folder(path, f"delete it, or have {CACHE_VARIABLE} name a folder of your own")


def prepare_jax(core: int | None = None, device: Literal["cpu", "gpu"] | None = None) -> None:
    """Set this process up to run work units, on one CPU core or, with None, where the system likes.

    JAX computes on the CPU and leaves GPUs alone, or with `device="gpu"` on a GPU if it can use one. Without a `device`
    JAX_PLATFORMS decides, and if it is not set, the CPU.

    Raises:
        UserError: as `cache_folder`.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = " ".join([flags, *(flag for flag in XLA_FLAGS if flag not in flags)]).strip()
    os.environ.update(dict.fromkeys(THREADS, "1"))
    if core is not None and sys.platform == "linux":  # no other system can
        for thread in os.listdir("/proc/self/task"):  # all of this process; those yet to come follow them
            os.sched_setaffinity(int(thread), {core})
    import jax  # reads the environment above

    programs = own_folder(cache_folder() / "jax", "delete it")
    remove_damaged(programs)
    asked = os.environ.get("JAX_PLATFORMS")
    jax.config.update("jax_platforms", {"cpu": "cpu", "gpu": asked, None: asked or "cpu"}[device])
    for name, value in SETTLED.items():
        jax.config.update(name, value)
    jax.config.update("jax_compilation_cache_dir", str(programs))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", MIN_COMPILE_SECONDS)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def jax_sees_a_gpu() -> bool:
    import jax

    return jax.default_backend() == "gpu"


def own_cores() -> list[int]:
    """The CPU cores that this process may keep busy: a container's quota may be smaller than their number."""
    return _allowed_cores()[: cpu_count()]


def own_core(neighbours: int) -> int | None:
    """A core that this process has to itself among all workers of this machine, until it ends.

    None leaves the core to the system: `neighbours`, the workers that this machine is to have, this one included, are
    fewer than the cores that they may use, or a container's quota is smaller than those; then others are on them, too.
    """
    cores = _allowed_cores()
    if sys.platform != "linux" or neighbours < len(cores) or len(own_cores()) < len(cores):
        return None
    end = time.monotonic() + CLAIMING
    while time.monotonic() < end:
        for core in cores:
            claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            try:
                claim.bind(f"\0levelproof on core {core}")  # a name and no file: the system frees it with the process
            except OSError:
                claim.close()
                continue
            CLAIMS.append(claim)
            return core
        time.sleep(CLAIMING / 10)  # a worker that died before this one may be on its way out
    return None


def _allowed_cores() -> list[int]:
    if sys.platform == "linux":
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))
