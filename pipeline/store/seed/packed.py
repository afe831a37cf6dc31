"""Packed witnesses: the actions of an episode as a few bytes per entry. docs/seeds.md describes them.

A byte below ENTRIES begins an entry of the action; entries that are always 0 have none. Every other byte is a run of
equal values of the current entry: ENTRIES + CHANGES * steps + the change of value before it, modulo the entry's
choices. A run of 0 steps lasts until the end of the episode.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Int

from levelproof.experts.config import RECORD_STEPS
from levelproof.levelgen.level import MOTOR_BINDINGS, THRUSTER_BINDINGS
from levelproof.levelgen.task.actions import CHOICES

ENTRIES, CHANGES = len(CHOICES), max(CHOICES)
MAX_RUN = (255 - ENTRIES) // CHANGES - 1  # env steps; longer runs continue in another byte, without a change
MAX_BYTES = ENTRIES * (RECORD_STEPS + 1)  # of a witness: each entry changes at every env step
NAMES = [("", f"motor {k} forward", f"motor {k} backward") for k in range(MOTOR_BINDINGS)]
NAMES += [("", f"thruster {k} on") for k in range(THRUSTER_BINDINGS)]  # by entry and value


def pack_witness(action: Int[np.ndarray, "step 6"], live: Bool[np.ndarray, " 6"]) -> bytes:
    """Pack the actions of an episode over its live entries."""
    packed = bytearray()
    for entry in np.flatnonzero(action.any(0) & live).tolist():
        values = action[:, entry].tolist()
        packed.append(entry)
        before, length = 0, 0
        change = (values[0] - before) % CHOICES[entry]
        for step, value in enumerate(values):
            if step and (value != before or length == MAX_RUN):
                packed.append(ENTRIES + CHANGES * length + change)
                change, length = (value - before) % CHOICES[entry], 0
            before, length = value, length + 1
        packed.append(ENTRIES + change)
    return bytes(packed)


def witness_text(witness: bytes, steps: int) -> str:
    """Return a packed witness as text: a line for each run of equal actions, such as "0-12: motor 0 forward".

    Args:
        witness: the column of this name in a seed file.
        steps: the column `steps_to_goal`.

    Raises:
        ValueError: it is not a witness of `steps` env steps.
    """
    action = unpack_witnesses([witness], np.array([steps]))[:steps, :, 0]
    begins = np.flatnonzero(np.concatenate([[True], (action[1:] != action[:-1]).any(1)])).tolist()
    lines = []
    for begin, end in pairwise([*begins, steps]):
        used = ", ".join(NAMES[entry][value] for entry, value in enumerate(action[begin].tolist()) if value)
        lines.append(f"{begin if end - begin == 1 else f'{begin}-{end - 1}'}: {used or 'nothing'}")
    return "\n".join(lines)


def unpack_witnesses(packed: Sequence[bytes], steps: Int[np.ndarray, " level"]) -> Int[np.ndarray, "256 6 level"]:
    """Unpack the actions of several episodes, zeros after their ends.

    Raises:
        ValueError: these are not witnesses of `steps` env steps.
    """
    count = len(packed)
    level = np.repeat(np.arange(count), [len(one) for one in packed])
    data = np.frombuffer(b"".join(packed), np.uint8).astype(np.int64)
    if not ((steps > 0) & (steps <= RECORD_STEPS)).all():
        raise ValueError(f"its witnesses are not from 1 to {RECORD_STEPS} env steps long")
    begins = data < ENTRIES
    first = np.concatenate([[True], level[1:] != level[:-1]])[: len(level)]
    if (first & ~begins).any() or (data >= ENTRIES + CHANGES * (MAX_RUN + 1)).any():
        raise ValueError("its witnesses do not begin with an entry, or have unknown bytes")
    part = np.cumsum(begins) - 1  # entries, one after another
    entry, owner = data[begins], level[begins]
    again = (owner[1:] == owner[:-1]) & (entry[1:] <= entry[:-1])
    runs = ~begins
    part, length, change = part[runs], (data[runs] - ENTRIES) // CHANGES, (data[runs] - ENTRIES) % CHANGES
    last = np.concatenate([part[1:] != part[:-1], [True]])[: len(part)]
    known = np.bincount(part, length, minlength=len(entry)).astype(np.int64)
    left = steps[owner] - known
    if again.any() or (np.bincount(part, minlength=len(entry)) == 0).any():
        raise ValueError("its witnesses repeat an entry, or have one without a run")
    if (last != (length == 0)).any() or (left <= 0).any():
        raise ValueError("its witnesses have runs that do not add up to their env steps")
    length[last] = left
    total = np.cumsum(change)
    before = np.concatenate([[0], total[last][:-1]])[: len(entry)]
    choices = np.array(CHOICES)[entry]
    if (change >= choices[part]).any():
        raise ValueError("its witnesses have actions that their entries do not have")
    value = (total - before[part]) % choices[part]
    action = np.zeros((RECORD_STEPS, ENTRIES, count), np.int8)
    flat = np.repeat(value, length)
    ends = np.cumsum(length)
    offset = np.concatenate([[0], ends[last][:-1]])[: len(entry)]
    where = np.repeat(part, length)
    action[np.arange(len(flat)) - offset[where], entry[where], owner[where]] = flat
    return action
