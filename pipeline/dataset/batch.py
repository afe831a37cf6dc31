"""What training code gets: trajectories or windows of them, batch first."""

import difflib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from levelproof.experts.witness.witness import Record
from levelproof.levelgen.level import Level
from levelproof.physics.types import Size, State
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.store.contents import table_for
from levelproof.pipeline.store.fields import tree_of

T = TypeVar("T")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Batch:
    """Trajectories, or windows of them: numpy arrays [batch, time, ...]. One of them: the same without `batch`.

    A step is what is seen, what is done then, and what that gives. Episodes follow each other in a record: behind a
    step that is `done`, the level starts again.
    """

    level_id: Int[np.ndarray, " batch"]
    first: Int[np.ndarray, " batch"]  # step of the record at which a window starts
    mask: Bool[np.ndarray, "batch time"]  # False: a step that only fills up a window or a batch
    observation: Any  # of the kind that was asked for, jax arrays [batch, time, ...]; None: none was
    action: Int[np.ndarray, "batch time 6"]  # multi-discrete (`levelgen.task.actions`)
    action_mask: Bool[np.ndarray, "batch time 6"]  # which entries of an action can have an effect
    reward: Float[np.ndarray, "batch time"]
    done: Bool[np.ndarray, "batch time"]  # the step ended its episode
    terminated: Bool[np.ndarray, "batch time"]  # by the task: nothing follows, and the value there is 0
    truncated: Bool[np.ndarray, "batch time"]  # by the time limit: the value there is that of the state reached
    goal: Bool[np.ndarray, "batch time"]  # by reaching the goal
    fields: dict[str, np.ndarray]  # the others that were asked for, by their names

    @property
    def state(self) -> State:
        """The world before each action."""
        return self._tree(State, "record/state/")

    @property
    def record(self) -> Record:
        """All that changes along time."""
        return self._tree(Record, "record/")

    @property
    def level(self) -> Level:
        """The levels that are played, [batch, ...]."""
        return self._tree(Level, "level/")

    def _tree(self, kind: type[T], path: str) -> T:
        try:
            return tree_of(kind, self.fields, path)
        except KeyError as error:
            raise UserError(f"The field {error.args[0]} was not read: ask for fields=[{path[:-1]!r}].") from None


def named(fields: Iterable[str], size: Size) -> list[str]:
    """The names of fields: each as it is, or all that are below a name, such as `record/state`.

    Raises:
        UserError: there is no such field.
    """
    known, chosen = [field.name for field in table_for(size)], []
    for word in [fields] if isinstance(fields, str) else fields:
        found = [name for name in known if name == word or name.startswith(f"{word}/")]
        if not found:
            near = difflib.get_close_matches(word, [*known, "record/state", "record", "level"], n=1, cutoff=0.3)
            hint = f", is {near[0]} meant" if near else ""
            raise UserError(f"There is no field {word!r}{hint}? levelproof.Record and levelproof.Level have them all.")
        chosen += found
    return list(dict.fromkeys(chosen))
