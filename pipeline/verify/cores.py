"""The cores that a verification uses: one process each, if there are levels enough."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any, Literal, NamedTuple

from levelproof.levelgen.sampling.sampler import CHUNK
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.processes import other_processes
from levelproof.pipeline.runtime import jax_sees_a_gpu, own_cores, prepare_jax

BLOCK = 2 * CHUNK  # rows that a process examines at once
LEAST = 16 * CHUNK  # rows for each process: it starts in the time that half of them take

Device = Literal["cpu", "gpu"] | None  # of `prepare_jax`
Map = Callable[..., Iterator[Any]]


class Cores(NamedTuple):
    """Processes that examine rows."""

    processes: int
    map: Map  # its functions and their arguments must be picklable; results come in order


@contextmanager
def on_cores(rows: int, device: Device) -> Iterator[Cores]:
    """Yield as many processes as there are cores and `rows` is worth; this one if that is one, or for a GPU.

    Raises:
        Failure: a process died.
    """
    count = 1 if jax_sees_a_gpu() else min(len(own_cores()), rows // LEAST)
    cores = Cores(1, map)
    with ExitStack() as stack:
        if count > 1:
            with suppress(Failure):  # this machine cannot start others
                cores = Cores(count, stack.enter_context(other_processes(count, prepare_jax, None, device)))
        yield cores
