"""One person at one level: steps of the engine, edits with undo, the witness of an episode that reaches the goal."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.witness.witness import replay, steps_to_goal, succeeds
from levelproof.levelgen.edit import EDITS, EditError, bodies_at, one_of
from levelproof.levelgen.files.entries import LevelFileError
from levelproof.levelgen.files.level_file import LevelFile, from_document, to_document
from levelproof.levelgen.level import ACTIONS, SIZES, Level, Role, name_of, size_of
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import CHOICES
from levelproof.levelgen.task.rules import TaskParams, TaskState
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.look.gallery.worlds import drawn_bodies, world_of
from levelproof.pipeline.version import __version__

WITNESS = "witness"  # entry of a level file: actions that solve the level, which other programs do not read
MAX_UNDONE = 200  # edits that can be taken back
Asked = dict[str, Any]


class Session:
    """What a page asks for, by name (`ASKS`). Answers are what JSON takes."""

    def __init__(self, file: LevelFile, actions: np.ndarray | None = None) -> None:
        """`actions`, [step, 6], are a witness that came with the level."""
        self._take(file)
        self._witness = actions
        self._undone: list[Level] = []
        self._done: list[Level] = []

    @property
    def file(self) -> LevelFile:
        return self._file

    def ask(self, asked: Asked) -> Asked:
        """The answer to `{"ask": name, ...}`; a sentence under `error` where there is none."""
        try:
            name = asked.get("ask")
            if name not in ASKS:
                raise UserError(f"Nobody can be asked for {name!r}.")
            return ASKS[name](self, asked)
        except (UserError, EditError, LevelFileError) as error:
            return {"error": str(error)}
        except (KeyError, TypeError, ValueError, IndexError, OverflowError):
            return {"error": "That is not something to ask for."}

    def level(self, _: Asked) -> Asked:
        """How the level looks at the start, and what there is to change in it."""
        one, file = one_of(self._file.level), self._file
        bodies, _still = drawn_bodies(one)
        joints, thrusters = np.flatnonzero(one.model.joint_active), np.flatnonzero(one.model.thruster_active)
        return {
            "world": world_of(one),
            "size": name_of(file.level.size),
            "sizes": list(SIZES),
            "roles": [role.name.lower() for role in Role],
            "bodies": bodies.tolist(),
            "fixed": (one.model.inverse_mass[bodies] == 0).tolist(),
            "joints": joints.tolist(),
            "thrusters": thrusters.tolist(),
            "seconds": file.rules.frame_skip * file.rules.physics.dt,
            "steps": file.rules.max_timesteps,
            "witness": self._witness is not None,
            "undo": bool(self._done),
            "redo": bool(self._undone),
        }

    def restart(self, _: Asked) -> Asked:
        """The start of an episode."""
        self._now, self._actions = task.reset(self._file.level), []
        return self._moment()

    def step(self, asked: Asked) -> Asked:
        """One env step under `action`."""
        action = _action(asked["action"])
        self._now, outcome = _advance(self._file.level, self._now, action[:, None], self._file.rules)
        self._actions.append(action)
        done, goal = bool(outcome.done[0]), bool(outcome.goal[0])
        if goal and len(self._actions) <= RECORD_STEPS:
            self._witness = np.stack(self._actions)
        moment = self._moment() | {"done": done, "goal": goal}
        if done:
            self._now, self._actions = task.reset(self._file.level), []
        return moment

    def edit(self, asked: Asked) -> Asked:
        """The level after one of `levelgen.edit.EDITS`, called `name`, with the words `with`."""
        before = self._file.level
        after = EDITS[asked["name"]](before, *asked["with"])
        from_document(to_document(replace(self._file, level=after)))  # nothing is edited into what no file can hold
        self._done = [*self._done[1 - MAX_UNDONE :], before]
        self._undone = []
        return self._changed(after)

    def undo(self, _: Asked) -> Asked:
        """The level before the last edit."""
        return self._exchanged(self._done, self._undone)

    def redo(self, _: Asked) -> Asked:
        """The level after the edit that was taken back last."""
        return self._exchanged(self._undone, self._done)

    def at(self, asked: Asked) -> Asked:
        """Numbers of the bodies at a point, the uppermost first."""
        return {"bodies": bodies_at(self._file.level, float(asked["x"]), float(asked["y"]))}

    def empty(self, asked: Asked) -> Asked:
        """A level of a `size` with nothing in it."""
        file = replace(self._file, level=jax.tree.map(np.asarray, empty_level(size_of(str(asked["size"])), 1)))
        return self._open(file, None)

    def load(self, asked: Asked) -> Asked:
        """The level of a level file's `document`."""
        file = from_document(asked["document"])
        return self._open(file, witness_in(asked["document"], file))

    def save(self, _: Asked) -> Asked:
        """The level as a level file's document, with the witness if there is one."""
        document = to_document(self._file)
        return {"document": document if self._witness is None else document | {WITNESS: self._told(self._witness)}}

    def play(self, _: Asked) -> Asked:
        """Every place of the bodies along the witness."""
        if self._witness is None:
            raise UserError("There is no witness yet: reach the goal, or let an expert be trained.")
        return self.film(self._witness)

    def film(self, actions: np.ndarray) -> Asked:
        """Where bodies are before each of these actions, and at the end."""
        state = replay(self._file.level, _padded(actions), self._file.rules).state
        position, rotation = (np.asarray(x)[: len(actions) + 1, ..., 0] for x in (state.position, state.rotation))
        return {"places": places_of(self._file.level, position, rotation), "actions": actions.tolist()}

    def solve(self, actions: np.ndarray) -> None:
        """Take over a witness that an expert has found."""
        self._witness = actions

    def _told(self, actions: np.ndarray) -> dict[str, Any]:
        return {"actions": actions.tolist(), "steps_to_goal": len(actions), "levelproof": __version__}

    def _open(self, file: LevelFile, witness: np.ndarray | None) -> Asked:
        self._take(file)
        self._done, self._undone, self._witness = [], [], witness
        return self.level({})

    def _exchanged(self, wanted: list[Level], instead: list[Level]) -> Asked:
        if not wanted:
            return self.level({})
        instead.append(self._file.level)
        return self._changed(wanted.pop())

    def _changed(self, level: Level) -> Asked:
        self._take(replace(self._file, level=level))
        self._witness = None  # of another level
        return self.level({})

    def _take(self, file: LevelFile) -> None:
        self._file = replace(file, level=jax.tree.map(np.asarray, file.level))
        self._now: TaskState = task.reset(self._file.level)
        self._actions: list[np.ndarray] = []

    def _moment(self) -> Asked:
        position, rotation = (np.asarray(x)[None, ..., 0] for x in (self._now.state.position, self._now.state.rotation))
        (places,) = places_of(self._file.level, position, rotation)
        return {"places": places, "timestep": len(self._actions)}


ASKS: dict[str, Callable[[Session, Asked], Asked]] = {
    ask.__name__: ask
    for ask in (
        Session.level, Session.restart, Session.step, Session.edit, Session.undo, Session.redo, Session.at,
        Session.empty, Session.load, Session.save, Session.play,
    )
}  # fmt: skip


@partial(jax.jit, static_argnames="rules")
def _advance(level: Level, now: TaskState, action: Any, rules: TaskParams) -> Any:
    return task.advance(level, now, action, rules)


def places_of(
    level: Level, position: Float[np.ndarray, "time body 2"], rotation: Float[np.ndarray, "time body"]
) -> list[list[float]]:
    """x, y and angle of the drawn bodies of a level, one after the other, at each time."""
    bodies, _ = drawn_bodies(one_of(level))
    where = np.concatenate([position, rotation[..., None]], -1)[:, bodies]
    return np.nan_to_num(where).reshape(len(where), -1).round(4).tolist()


def witness_in(document: Any, file: LevelFile) -> np.ndarray | None:
    """The actions, [step, 6], that come with a level file; None where there are none, or they do not solve it."""
    given = document.get(WITNESS)
    if not isinstance(given, dict) or not isinstance(given.get("actions"), list):
        return None
    try:
        actions = np.stack([_action(action) for action in given["actions"][:RECORD_STEPS]])
    except (ValueError, TypeError, OverflowError):
        return None
    record = replay(file.level, _padded(actions), file.rules)
    solves = succeeds(record.done[: len(actions)], record.goal[: len(actions)])[0]
    return actions[: int(steps_to_goal(record.done)[0])] if solves else None


def _action(given: Any) -> np.ndarray:
    """Six entries, each one of its choices."""
    action = np.array(given, np.int32)
    if action.shape != (ACTIONS,) or (action < 0).any() or (action >= CHOICES).any():
        raise ValueError
    return action


def _padded(actions: np.ndarray) -> np.ndarray:
    """[256, 6, 1], doing nothing afterwards."""
    padded = np.zeros((RECORD_STEPS, ACTIONS, 1), np.int32)
    padded[: len(actions), :, 0] = actions
    return padded


def empty_file(size: str) -> LevelFile:
    """A level of a size with nothing in it, and the usual rules.

    Raises:
        UserError: there is no such size.
    """
    try:
        return LevelFile(empty_level(size_of(size), 1), TaskParams())
    except ValueError as error:
        raise UserError(f"{error}.") from None
