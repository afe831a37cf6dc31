"""The latest transitions of teachers, from which updates draw; part of a run's checkpoint."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from levelproof.experts.generalist.teachers import Labels


class LabelBuffer(NamedTuple):
    """A ring of transitions."""

    level: Int[np.ndarray, " row"]  # index among the run's levels
    motion: Float[np.ndarray, "row column"]
    action: Int[np.ndarray, "row 6"]
    added: Int[np.ndarray, ""]  # transitions so far; the next one is written at `added` modulo the number of rows

    @property
    def filled(self) -> int:
        """Rows with a transition."""
        return min(int(self.added), len(self.level))


def empty_labels(rows: int, columns: int) -> LabelBuffer:
    """Return a buffer without transitions."""
    action = np.zeros((rows, 6), np.int8)
    return LabelBuffer(np.zeros(rows, np.int32), np.zeros((rows, columns), np.float32), action, np.zeros((), np.int32))


def with_labels(buffer: LabelBuffer, level: Int[np.ndarray, " state"], labels: Labels, path: int) -> LabelBuffer:
    """Return a buffer with the transitions of labels, in place of the oldest.

    Args:
        buffer: unchanged.
        level: index of each state's level.
        labels: what teachers did in these states.
        path: maximum number of env steps to add per label, evenly spaced from its first to its last; 1: the first.
    """
    steps = [np.linspace(0, length - 1, min(path, length)).round().astype(int) for length in labels.length.tolist()]
    state = np.repeat(np.arange(len(steps)), [len(each) for each in steps])
    step = np.concatenate(steps)
    rows = len(buffer.level)
    state, step = state[-rows:], step[-rows:]
    at = (int(buffer.added) + np.arange(len(state))) % rows
    levels, motion, action = (x.copy() for x in buffer[:3])
    levels[at], motion[at], action[at] = level[state], labels.motion[step, state], labels.action[step, :, state]
    return LabelBuffer(levels, motion, action, np.array(buffer.added + len(state), np.int32))
