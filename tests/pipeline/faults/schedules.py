"""Fault schedules, each made from a seed: a command, a fault, and the effect at which it happens."""

import random
from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

LEVELS = 6
ALL = f"levels={LEVELS}"
GENERATE = ("generate", "size=s", ALL, "unit=2", "budget=128k", "executor=inline", "keep_experts=true")
REGENERATE = ("regenerate", "manifest=OUT/128k/s", "budget=256k", "executor=inline", "unit=2", "out=OUT")


class Operation(NamedTuple):
    """A command and the state before it; `OUT` is replaced by the folder or the store's URL."""

    words: tuple[str, ...]
    before: tuple[tuple[str, ...], ...] = ()  # commands that run first
    left: bool = False  # add what dead processes leave
    beside: bool = False  # the command seals during the job
    works: bool = True  # the command has a worker


OPERATIONS = {
    "generate": Operation((*GENERATE, "out=OUT")),
    "generate, sealing beside": Operation((*GENERATE, "out=OUT"), beside=True),
    "generate on leftovers": Operation((*GENERATE, "out=OUT"), left=True),
    "regenerate": Operation(REGENERATE, ((*GENERATE, "out=OUT"),)),
    "seal": Operation(("seal", "OUT/128k/s"), ((*GENERATE, "out=OUT"),), works=False),
    "change of density": Operation(
        ("seal", "OUT/128k/s", "--density", "resume"), ((*GENERATE, "out=OUT"),), works=False
    ),
}
STORED = ("generate", "seal")  # operations that also run in an object store

OF_PROCESSES = {  # faults at an effect, and the processes that they may hit
    "a kill": ("driver", "worker"),
    "a kill of all": ("driver", "worker"),
    "loss of power": ("driver", "worker"),
    "a kill of the driver, the worker goes on": ("worker",),
    "a kill within a write": ("all",),
    "a second command": ("driver", "worker"),
    "no space, once": ("driver", "worker"),
    "no space from then on": ("driver", "worker"),
    "an input/output error, once": ("driver", "worker"),
    "input/output errors from then on": ("driver", "worker"),
    "read-only from then on": ("driver", "worker"),
    "files that grow too large": ("all",),
    "a disk that is really full": ("all",),
    "slow writes": ("driver", "worker"),
    "a clock that goes back": ("driver",),
}
OF_STORES = {  # faults at a request to the store
    "a kill": ("driver", "worker"),
    "a kill of all": ("all",),
    "a kill of the driver, the worker goes on": ("worker",),
    "a store that is gone from then on": ("all",),
    "lost answers": ("all",),
    "a busy store": ("all",),
    "a second command": ("all",),
}
OFTEN = {"a kill": 3, "a kill of all": 2, "loss of power": 3, "a kill of the driver, the worker goes on": 2}


class Schedule(NamedTuple):
    """An operation, its fault, the process that the fault hits, and when."""

    seed: int
    operation: str
    place: str  # folder, store
    fault: str
    whose: str  # driver, worker, all
    when: float  # share of an undisturbed run's effects before the fault
    again: float  # share of the second run's effects before a worker that has outlived its driver continues

    def __str__(self) -> str:
        where = "" if self.place == "folder" else " in a store"
        return f"{self.seed}: {self.operation}{where}, {self.fault} ({self.whose}) after {self.when:.1%}"


def _cells() -> list[tuple[str, str, str, str]]:
    """Return all combinations, important ones several times, in a fixed random order."""
    cells = []
    for name, operation in OPERATIONS.items():
        for place, faults in (("folder", OF_PROCESSES), ("store", OF_STORES if name in STORED else {})):
            for fault, processes in faults.items():
                hit = [who for who in processes if operation.works or who != "worker"]
                often = OFTEN.get(fault, 1) * (1 if operation.works else 2) if place == "folder" else 1
                cells += [(name, place, fault, who) for who in hit] * often
    random.Random(0).shuffle(cells)
    return cells


CELLS = _cells()


def schedule_of(seed: int) -> Schedule:
    dice = random.Random(seed)
    return Schedule(seed, *CELLS[seed % len(CELLS)], dice.random(), dice.random())


def table(schedules: Iterable[Schedule]) -> str:
    """Return a Markdown table of the number of schedules by fault and operation."""
    schedules = list(schedules)
    columns = list(dict.fromkeys((name, place) for place in ("folder", "store") for name in OPERATIONS))
    columns = [(name, place) for name, place in columns if place == "folder" or name in STORED]
    count = Counter((schedule.fault, schedule.operation, schedule.place) for schedule in schedules)
    heads = [name + (" (store)" if place == "store" else "") for name, place in columns]
    lines = [f"| fault | {' | '.join(heads)} | all |", "|---|" + "---|" * (len(heads) + 1)]
    for fault in dict.fromkeys([*OF_PROCESSES, *OF_STORES]):
        row = [count[fault, *column] for column in columns]
        lines.append(f"| {fault} | {' | '.join(str(n or '') for n in row)} | {sum(row)} |")
    totals = [sum((one.operation, one.place) == column for one in schedules) for column in columns]
    return "\n".join([*lines, f"| all | {' | '.join(map(str, totals))} | {len(schedules)} |"])
