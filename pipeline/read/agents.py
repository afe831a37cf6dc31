"""Agents of any library, in Python files that users name."""

import runpy
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from levelproof.experts.evaluation import Moment
from levelproof.levelgen.task.actions import CHOICES, action_mask
from levelproof.levelgen.task.observe.flat import symbolic_flat
from levelproof.pipeline.errors import UserError

ACT = "act"  # the function that a file must define
SUFFIX = ".py"


class Agent:
    """A player that calls a function of NumPy arrays, on the host, for all lanes at once.

    The function is called as act(observation, live, uniform): symbolic-flat observations, float32
    [lane, feature]; which entries of the action have an effect, bool [lane, 6]; and random numbers in [0, 1), float32
    [lane, 6]. It returns integers [lane, 6]. An agent that draws from these numbers alone gives the same results every
    time.
    """

    def __init__(self, name: str, act: Callable[..., Any], neighbours: "Neighbours") -> None:
        self.name, self.act, self.neighbours = name, act, neighbours
        self.error: str | None = None  # the first failure; afterwards the agent does nothing

    def __call__(self, params: Any, moment: Moment) -> Int[Array, "6 lane"]:
        observation = symbolic_flat(moment.level, moment.now.state)
        shape = jax.ShapeDtypeStruct(moment.previous.shape, jnp.int32)
        live = jnp.broadcast_to(action_mask(moment.level), shape.shape)
        return jax.pure_callback(self._actions, shape, observation, live, moment.uniform)

    def _actions(self, *lanes_last: Any) -> np.ndarray:
        observation, live, uniform = (np.array(np.asarray(x).T, order="C") for x in lanes_last)  # which it may change
        nothing = np.zeros(uniform.shape[::-1], np.int32)
        if self.error is not None:
            return nothing
        try:
            with self.neighbours.within_reach():
                action = np.asarray(self.act(observation, live, uniform))
        except Exception as error:
            self.error = f"{ACT} of {self.name} failed: {type(error).__name__}: {error}"
            return nothing
        if action.shape != uniform.shape or not np.issubdtype(action.dtype, np.integer):
            self.error = (
                f"{ACT} of {self.name} returned {action.dtype} {list(action.shape)}: it must return integers "
                f"{list(uniform.shape)}, the choice of each entry"
            )
            return nothing
        if ((action < 0) | (action >= np.array(CHOICES))).any():
            self.error = f"{ACT} of {self.name} returned choices out of range: the entries have {list(CHOICES)} choices"
            return nothing
        return action.astype(np.int32).T


class Neighbours:
    """The modules beside an agent's file, which it may import; those of another agent may have the same names."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._imported = dict[str, ModuleType]()

    @contextmanager
    def within_reach(self) -> Iterator[None]:
        """Let code import these modules, as `python FILE` does; afterwards no other code finds them."""
        before = set(sys.modules)
        sys.path.insert(0, str(self._folder))
        sys.modules.update(self._imported)
        try:
            yield
        finally:
            with suppress(ValueError):  # the agent may have changed the list
                sys.path.remove(str(self._folder))
            for name in sys.modules.keys() - before:
                if name in self._imported or self._has(name, before):
                    self._imported[name] = sys.modules.pop(name)

    def _has(self, name: str, before: Collection[str]) -> bool:
        """Whether a module that was imported after those of `before` is one of the folder's, or within one."""
        beside = self._folder / (top := name.partition(".")[0])
        is_here = beside.with_suffix(".py").is_file() or (beside / "__init__.py").is_file()
        return is_here and top not in {other.partition(".")[0] for other in before}


def agent_in(file: Path) -> Agent:
    """Run a Python file, which may import its neighbours, and return the agent whose function `act` it defines.

    Raises:
        UserError: there is no such file, it fails, or it has no such function.
    """
    if not file.is_file():
        raise UserError(f"There is no agent at {file}: name a Python file that defines {ACT}.")
    neighbours = Neighbours(file.parent.absolute())
    try:
        with neighbours.within_reach():
            act = runpy.run_path(str(file)).get(ACT)
    except (Exception, SystemExit) as error:
        raise UserError(f"{file} failed: {type(error).__name__}: {error}.") from None
    if not callable(act):
        raise UserError(f"{file} defines no function {ACT}: docs/evaluate.md says what it is called with.")
    return Agent(str(file), act, neighbours)
