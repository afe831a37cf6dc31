"""Number of workers for each machine of a cluster, by its cores or GPUs and its memory. Knows nothing of Ray."""

from collections import Counter
from collections.abc import Mapping
from math import inf
from typing import Any

from levelproof.levelgen.level import SIZES
from levelproof.physics.types import Size

Machine = Mapping[str, Any]  # a machine's entry in Ray's list of nodes
GB = 10**9  # bytes
# Largest number of bodies, and bytes of a worker. Compiling takes the most: measured 1.35 GB for s and 1.64 for l
BYTES = ((SIZES["s"].bodies, 1.5 * GB), (SIZES["l"].bodies, 1.8 * GB))
MAX_BYTES = 2.5 * GB  # memory of a worker for larger sizes; an estimate


def bytes_of_worker(size: Size) -> int:
    """Return the memory that a worker for levels of this size needs, in bytes."""
    return int(next((needed for bodies, needed in BYTES if size.bodies <= bodies), MAX_BYTES))


def workers_by_machine(machines: Mapping[str, Machine], kind: str, most: int, memory: int) -> Counter[str]:
    """Spread at most `most` workers evenly over the machines; return their number by machine.

    Each worker has its own core or GPU (`kind`, "CPU" or "GPU") and `memory` bytes. A machine with too little memory
    for one worker still gets one.
    """
    count = {name: min(_units(machine, kind), max(1, _fit(machine, memory))) for name, machine in machines.items()}
    turns = sorted((turn, name) for name, number in count.items() for turn in range(number))  # one on each, then more
    return Counter(name for _, name in turns[:most])


def shortage(machine: Machine, kind: str, most: int, memory: int) -> str:
    """Return a sentence if too little memory leaves cores or GPUs of a machine without a worker; else an empty one."""
    units, fit = _units(machine, kind), _fit(machine, memory)
    if fit >= min(units, most):
        return ""
    host, free = machine["NodeManagerHostname"], machine["Resources"]["memory"]
    return (
        f"{host} has {free / GB:.1f} GB of memory free, and a worker of this size needs {memory / GB:.1f} GB: "
        f"it runs {max(1, fit)} of {min(units, most)} workers."
    )


def memory_to_reserve(machine: Machine, memory: int) -> int:
    """Return the bytes to reserve for a worker: those that it needs, but at most those that the machine has."""
    return int(min(memory, machine["Resources"].get("memory", memory)))


def _units(machine: Machine, kind: str) -> int:
    return int(machine["Resources"].get(kind, 0))


def _fit(machine: Machine, memory: int) -> int:
    """Return the number of workers that fit into a machine's memory."""
    return int(min(machine["Resources"].get("memory", inf) / memory, 2**31))
