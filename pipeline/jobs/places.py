"""Where workers have a place: the machines of a cluster, as Ray lists them, and their memory. Knows nothing of Ray."""

from collections import Counter
from collections.abc import Mapping
from math import inf
from typing import Any

from levelproof.levelgen.level import SIZES
from levelproof.physics.types import Size

Machine = Mapping[str, Any]  # as Ray describes it
GB = 10**9  # bytes
# Bytes of a worker by the number of bodies, at most. Compiling takes the most: 1.35 GB were measured for s, 1.64 for l
BYTES = ((SIZES["s"].bodies, 1.5 * GB), (SIZES["l"].bodies, 1.8 * GB))
MAX_BYTES = 2.5 * GB  # of a worker of larger sizes; an estimate


def bytes_of_worker(size: Size) -> int:
    """Memory that a worker for levels of this size needs."""
    return int(next((each for most, each in BYTES if size.bodies <= most), MAX_BYTES))


def places(machines: Mapping[str, Machine], kind: str, most: int, memory: int) -> Counter[str]:
    """Number of workers by machine, `most` in all, spread over as many machines as possible.

    Each worker has a core or a GPU (`kind`, Ray's name for it) and `memory` bytes to itself. A machine with too little
    memory for one worker still gets one.
    """
    count = {name: min(_units(of, kind), max(1, _fit(of, memory))) for name, of in machines.items()}
    turns = sorted((turn, name) for name, number in count.items() for turn in range(number))  # one on each, then more
    return Counter(name for _, name in turns[:most])


def shortage(machine: Machine, kind: str, most: int, memory: int) -> str:
    """A sentence that says that memory leaves cores or GPUs of a machine without a worker; empty: it does not."""
    units, fit = _units(machine, kind), _fit(machine, memory)
    if fit >= min(units, most):
        return ""
    host, free = machine["NodeManagerHostname"], machine["Resources"]["memory"]
    return (
        f"{host} has {free / GB:.1f} GB of memory free, and a worker of this size needs {memory / GB:.1f} GB: "
        f"it gets {max(1, fit)} of {min(units, most)} workers."
    )


def share_of_memory(machine: Machine, memory: int) -> int:
    """Bytes to reserve for a worker: as many as it needs, if the machine has as many."""
    return int(min(memory, machine["Resources"].get("memory", memory)))


def _units(machine: Machine, kind: str) -> int:
    return int(machine["Resources"].get(kind, 0))


def _fit(machine: Machine, memory: int) -> int:
    """Number of workers for which a machine has memory."""
    return int(min(machine["Resources"].get("memory", inf) / memory, 2**31))
