"""JAX's setup in a process that runs work units: a thread for each worker, and programs cached for the next process.

Takes effect only before JAX starts its backend.
"""

import gc
import os
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Literal

from loky import cpu_count

from levelproof.pipeline.claims import share_compiling
from levelproof.pipeline.owned import own_folder

CACHE_VARIABLE = "LEVELPROOF_CACHE_DIR"
# One single-threaded process per core is twice as fast as one process with XLA's own threads. Besides, a sum split
# over threads would make a level's bits depend on the machine's number of cores.
XLA_FLAGS = (
    "--xla_cpu_multi_thread_eigen=false",
    "--xla_cpu_prefer_vector_width=512",  # ignored if the processor lacks such vectors
)
XLA_THREADS = "NPROC", "PJRT_NPROC"  # size of XLA's pool
NUMPY_THREADS = "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"
NO_GPU = "JAX finds no usable GPU (check that levelproof's extra `gpu` is installed)"
COMPRESSED = {b"\x28", b"\x78"}  # first bytes of what zstd and zlib write
UNFINISHED = 3600.0  # s after which a file that a process began to write is a killed one's
LAST_CHECK = "looked"  # file beside the programs, touched when a check begins; programs older than it were readable
CLAIM_SECONDS = 2.0  # s for which a worker tries to claim a core
CLAIMS: list[socket.socket] = []  # sockets that mark this process's core as taken
# Settings of JAX that change results or speed, or reject this code; an environment or configuration may have set them
JAX_SETTINGS = {
    "jax_enable_x64": False,
    "jax_default_matmul_precision": None,
    "jax_numpy_dtype_promotion": "standard",
    "jax_numpy_rank_promotion": "allow",
    "jax_disable_jit": False,
    "jax_debug_nans": False,  # diverging worlds contain NaNs
    "jax_debug_infs": False,
    "jax_cpu_enable_async_dispatch": False,  # else programs of several threads wait in one queue
}


def cache_folder() -> Path:
    """Return the folder for compiled code: LEVELPROOF_CACHE_DIR, else the user's cache folder.

    Raises:
        UserError: other users can write to it; JAX executes the code that it finds there.
    """
    if chosen := os.environ.get(CACHE_VARIABLE):
        path = Path(chosen).expanduser()
    elif sys.platform == "darwin":
        path = Path.home() / "Library" / "Caches" / "levelproof"
    else:
        path = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "levelproof"
    return own_folder(path, f"delete it, or set {CACHE_VARIABLE} to a folder of your own")


def prepare_jax(
    core: int | None = None, device: Literal["cpu", "gpu"] | None = None, devices: int = 1, threads: int = 1
) -> None:
    """Set this process up to run work units, or to train a policy.

    Args:
        core: CPU core to pin this process to; None leaves the choice to the system.
        device: "cpu": JAX ignores GPUs; "gpu": JAX uses a GPU if it can; None: JAX_PLATFORMS decides, by default the
            CPU.
        devices: devices that JAX shows for the CPU, each with a thread of its own.
        threads: threads of this process that run programs at the same time; with too few, they wait for each other.

    Raises:
        UserError: see `cache_folder`.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    wanted = [*XLA_FLAGS, *[f"--xla_force_host_platform_device_count={devices}"] * (devices > 1)]
    os.environ["XLA_FLAGS"] = " ".join([flags, *(flag for flag in wanted if flag not in flags)]).strip()
    os.environ.update(dict.fromkeys(XLA_THREADS, str(threads)))
    os.environ.update(dict.fromkeys(NUMPY_THREADS, "1"))
    if core is not None and sys.platform == "linux":  # other systems have no affinity
        _pin(core)
    import jax  # reads the environment above

    programs = own_folder(cache_folder() / "jax", "delete it")
    remove_damaged(programs)
    platforms = os.environ.get("JAX_PLATFORMS")
    jax.config.update("jax_platforms", {"cpu": "cpu", "gpu": platforms, None: platforms or "cpu"}[device])
    for name, value in JAX_SETTINGS.items():
        jax.config.update(name, value)
    jax.config.update("jax_compilation_cache_dir", str(programs))
    # Even the smallest programs: to load one takes a quarter of the time to compile it
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    share_compiling()


def _pin(core: int) -> None:
    """Pin all threads of this process to a core; later threads inherit the affinity."""
    for thread in os.listdir("/proc/self/task"):
        with suppress(ProcessLookupError):  # the thread has ended
            os.sched_setaffinity(int(thread), {core})


def spare_imports() -> None:
    """Exempt what this process's imports have made from garbage collection, once.

    Tracing makes the collector run often, and each run would scan all these objects.
    """
    if not gc.get_freeze_count():
        gc.freeze()


def remove_damaged(folder: Path) -> None:
    """Delete cached programs that changed since the last check and that JAX cannot read.

    JAX writes a program in place and never replaces one, so a program that a killed process or a full disk left
    half-written would be recompiled, with a warning, at every start.
    """
    from jax._src.compilation_cache import compress_executable, decompress_executable  # by the library that JAX chooses

    foreign = COMPRESSED - {compress_executable(b"")[:1]}  # of environments that have the other library

    last, new = folder / LAST_CHECK, folder / f".{LAST_CHECK}.{os.getpid()}"
    with suppress(OSError):  # the folder is not writable: JAX itself warns of damaged programs
        new.touch()
        since = last.stat().st_mtime_ns if last.exists() else 0
        for path in folder.glob(".levelproof-*"):  # what `physics.codegen.kept` was writing in a killed process
            with suppress(FileNotFoundError):  # its writer has just finished it
                if time.time() - path.stat().st_mtime > UNFINISHED:
                    path.unlink()
        for path in folder.glob("*-cache"):
            try:
                if path.stat().st_ctime_ns >= since:  # ns; ctime, because a copy may keep its original's mtime
                    data = path.read_bytes()
                    if data[:1] not in foreign:
                        decompress_executable(data)
            except OSError:  # it says nothing of the program
                continue
            except Exception:  # each compression library raises its own type
                path.unlink(missing_ok=True)
        new.replace(last)


def jax_sees_a_gpu() -> bool:
    """Whether JAX computes on a GPU; starts its backend."""
    import jax

    return jax.default_backend() == "gpu"


def own_cores() -> list[int]:
    """Return CPU cores for this process to use; fewer than a container shows if its CPU quota is lower."""
    return _allowed_cores()[: cpu_count()]


def own_core(neighbours: int) -> int | None:
    """Claim a core that no other worker of this machine uses, until this process ends.

    Returns None, which leaves the choice to the system, if there are more cores than workers, or if a container's
    quota is smaller than its number of cores: other containers then use the same cores.

    Args:
        neighbours: number of workers that this machine will have, including this one.
    """
    cores = _allowed_cores()
    if sys.platform != "linux" or neighbours < len(cores) or len(own_cores()) < len(cores):
        return None
    end = time.monotonic() + CLAIM_SECONDS
    while time.monotonic() < end:
        for core in cores:
            claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            try:
                claim.bind(f"\0levelproof on core {core}")  # abstract name, not a file: freed when the process ends
            except OSError:
                claim.close()
                continue
            CLAIMS.append(claim)
            return core
        time.sleep(CLAIM_SECONDS / 10)  # the worker that this one replaces may still be exiting
    return None


def _allowed_cores() -> list[int]:
    if sys.platform == "linux":
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))
