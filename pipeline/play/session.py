"""Session of one page: env steps, edits with undo, and the witness of an episode that reaches the goal."""

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
from levelproof.levelgen.sampling.sampler import check_size
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import CHOICES, controls
from levelproof.levelgen.task.rules import TaskParams, TaskState
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.look.gallery.contender import Contender
from levelproof.pipeline.look.gallery.worlds import drawn_bodies, world_of
from levelproof.pipeline.look.show import MAX_FRAME_SKIP
from levelproof.pipeline.version import __version__

WITNESS = "witness"  # entry of a level file with actions that solve the level; other programs ignore it
MAX_UNDO = 200  # maximum number of edits that can be undone
Message = dict[str, Any]  # JSON object between page and server


class Session:
    """State of one page's level; answers the requests named in `REQUESTS` with JSON types."""

    def __init__(self, file: LevelFile, actions: np.ndarray | None = None, contender: Contender | None = None) -> None:
        """`actions`, [step, 6], are the level's witness, or None; `contender` is the policy that plays on request."""
        self._take(file)
        self._witness = actions
        self._contender, self._attempts = contender, 0
        self._redo: list[Level] = []
        self._undo: list[Level] = []

    @property
    def file(self) -> LevelFile:
        return self._file

    def answer(self, request: Message) -> Message:
        """Answer `{"ask": name, ...}`; if that fails, with a sentence under `error`."""
        try:
            name = request.get("ask")
            if name not in REQUESTS:
                raise UserError(f"Unknown request {name!r}: use one of {', '.join(REQUESTS)}.")
            return REQUESTS[name](self, request)
        except (UserError, EditError) as error:
            return {"error": str(error)}
        except LevelFileError as error:
            return {"error": f"A level file cannot hold this level: {error}."}
        except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
            return {"error": f"The request is malformed ({type(error).__name__}: {error})."}

    def level(self, _: Message) -> Message:
        """Describe the initial world, and what can be edited in it."""
        one, file = one_of(self._file.level), self._file
        (bodies, _still), model = drawn_bodies(one), one.model
        joints = np.flatnonzero(model.joint_active & model.active[model.joint_a])  # as `site/draw.js` draws them
        thrusters = np.flatnonzero(model.thruster_active & model.active[model.thruster_body])
        return {
            "world": world_of(one),
            "size": name_of(file.level.size),
            "sizes": list(SIZES),
            "roles": [role.name.lower() for role in Role],
            "bodies": bodies.tolist(),
            "fixed": (model.inverse_mass[bodies] == 0).tolist(),
            "joints": joints.tolist(),
            "thrusters": thrusters.tolist(),
            "seconds": file.rules.frame_skip * file.rules.physics.dt,
            "steps": file.rules.max_timesteps,
            "longest": RECORD_STEPS,
            "witness": self._witness is not None,
            "policy": self._contender is not None and self._contender.policy.can_play(file.level.size),
            "undo": bool(self._undo),
            "redo": bool(self._redo),
        }

    def restart(self, _: Message) -> Message:
        """Start a new episode."""
        self._now, self._actions = task.reset(self._file.level), []
        return self._moment()

    def step(self, request: Message) -> Message:
        """Take one env step under `action`.

        `kept` says that the episode is the witness now, `failed` that green touched red, `broken` that the world has
        no numbers any more.
        """
        action = _action(request["action"])
        self._now, outcome, end = _advance(self._file.level, self._now, action[:, None], self._file.rules)
        self._actions.append(action)
        done, goal = bool(outcome.done[0]), bool(outcome.goal[0])
        kept = goal and len(self._actions) <= RECORD_STEPS
        if kept:
            self._witness = np.stack(self._actions)
        broken = bool(task.has_nan(self._now.state)[0])
        failed = bool(end.terminated[0]) and not (goal or broken)
        moment = self._moment() | {"done": done, "goal": goal, "kept": kept, "failed": failed, "broken": broken}
        if done:
            self._now, self._actions = task.reset(self._file.level), []
        return moment

    def edit(self, request: Message) -> Message:
        """Apply the edit `name` of `levelgen.edit.EDITS` with the arguments `with`."""
        before = self._file.level
        after = EDITS[request["name"]](before, *request["with"])
        from_document(to_document(replace(self._file, level=after)))  # raises if a level file cannot hold the result
        self._undo = [*self._undo[1 - MAX_UNDO :], before]
        self._redo = []
        return self._changed(after)

    def undo(self, _: Message) -> Message:
        """Undo the last edit."""
        return self._swap(self._undo, self._redo)

    def redo(self, _: Message) -> Message:
        """Redo the edit that was undone last."""
        return self._swap(self._redo, self._undo)

    def at(self, request: Message) -> Message:
        """Return the indices of the bodies at a point, topmost first."""
        return {"bodies": bodies_at(self._file.level, float(request["x"]), float(request["y"]))}

    def empty(self, request: Message) -> Message:
        """Replace the level by an empty one of `size`."""
        file = replace(self._file, level=jax.tree.map(np.asarray, empty_level(size_of(str(request["size"])), 1)))
        return self._open(file, None)

    def load(self, request: Message) -> Message:
        """Open a level file's `document`; `name` is the file's."""
        try:
            file = require_playable(from_document(request["document"]))
        except LevelFileError as error:
            raise UserError(f"Cannot use the level file {request['name']}: {error}.") from None
        return self._open(file, witness_in(request["document"], file))

    def save(self, _: Message) -> Message:
        """Convert the level to a level file's document, with its witness if it has one."""
        document = to_document(self._file)
        return {
            "document": document if self._witness is None else document | {WITNESS: self._witness_entry(self._witness)}
        }

    def play(self, _: Message) -> Message:
        """Return a film of the witness."""
        if self._witness is None:
            raise UserError("There is no witness yet: reach the goal, or train an expert.")
        return self.film(self._witness)

    def attempt(self, _: Message) -> Message:
        """Play the policy's next attempt; return its film, and keep it as the witness if it reaches the goal."""
        if self._contender is None or not self._contender.policy.can_play(self._file.level.size):
            raise UserError("No policy plays this level: name one that does with `levelproof play --policy POLICY`.")
        one = self._file.level, np.zeros(1, np.int32), self._file.rules
        (attempt,) = self._contender.attempts(*one, seed=self._attempts)
        self._attempts += 1
        actions = np.asarray(attempt.record.action[: attempt.steps])
        if attempt.solved:
            self._witness = actions
        return self.film(actions) | {"goal": attempt.solved}

    def film(self, actions: np.ndarray) -> Message:
        """Replay actions [step, 6]; return the bodies' positions and angles before each action and at the end."""
        level, rules = self._file.level, self._file.rules
        now = task.reset(level)
        states = [now.state]
        for action in actions:  # `replay` would reset the level when the episode ends, and lose its last state
            now, *_ = _advance(level, now, np.asarray(action, np.int32)[:, None], rules)
            states.append(now.state)
        position, rotation = (
            np.stack([np.asarray(x)[..., 0] for x in xs])
            for xs in ([state.position for state in states], [state.rotation for state in states])
        )
        return {"places": places_of(level, position, rotation), "actions": actions.tolist()}

    def solve(self, actions: np.ndarray) -> None:
        """Adopt a witness that an expert found."""
        self._witness = actions

    def _witness_entry(self, actions: np.ndarray) -> dict[str, Any]:
        return {"actions": actions.tolist(), "steps_to_goal": len(actions), "levelproof": __version__}

    def _open(self, file: LevelFile, witness: np.ndarray | None) -> Message:
        self._take(file)
        self._undo, self._redo, self._witness = [], [], witness
        return self.level({})

    def _swap(self, source: list[Level], target: list[Level]) -> Message:
        if not source:
            return self.level({})
        target.append(self._file.level)
        return self._changed(source.pop())

    def _changed(self, level: Level) -> Message:
        self._take(replace(self._file, level=level))
        self._witness = None  # the old one was for the level before the edit
        return self.level({})

    def _take(self, file: LevelFile) -> None:
        self._file = replace(file, level=jax.tree.map(np.asarray, file.level))
        self._now: TaskState = task.reset(self._file.level)
        self._actions: list[np.ndarray] = []

    def _moment(self) -> Message:
        position, rotation = (np.asarray(x)[None, ..., 0] for x in (self._now.state.position, self._now.state.rotation))
        (places,) = places_of(self._file.level, position, rotation)
        return {"places": places, "timestep": len(self._actions)}


REQUESTS: dict[str, Callable[[Session, Message], Message]] = {
    method.__name__: method
    for method in (
        Session.level, Session.restart, Session.step, Session.edit, Session.undo, Session.redo, Session.at,
        Session.empty, Session.load, Session.save, Session.play,
        Session.attempt,
    )
}  # fmt: skip


@partial(jax.jit, static_argnames="rules")
def _advance(level: Level, now: TaskState, action: Any, rules: TaskParams) -> Any:
    return task.advance_driven(level, now, controls(level, action), rules)[:3]


def places_of(
    level: Level, position: Float[np.ndarray, "time body 2"], rotation: Float[np.ndarray, "time body"]
) -> list[list[float]]:
    """List x, y, angle of each drawn body, one after the other, at each time."""
    bodies, _ = drawn_bodies(one_of(level))
    places = np.concatenate([position, rotation[..., None]], -1)[:, bodies]
    return np.nan_to_num(places).reshape(len(places), -1).round(4).tolist()


def require_playable(file: LevelFile) -> LevelFile:
    """Return the file. Raise UserError if an env step of its rules would take too long to play."""
    if (steps := file.rules.frame_skip) > MAX_FRAME_SKIP:
        raise UserError(
            f"This level's rules take {steps:,} physics steps per env step, but the player allows at most "
            f"{MAX_FRAME_SKIP}: choose another level, or lower its frame_skip."
        )
    return file


def witness_in(document: Any, file: LevelFile) -> np.ndarray | None:
    """Read the witness [step, 6] of a level file; None if it has none or its actions do not solve the level."""
    entry = document.get(WITNESS)
    if not isinstance(entry, dict) or not isinstance(entry.get("actions"), list):
        return None
    try:
        actions = np.stack([_action(action) for action in entry["actions"][:RECORD_STEPS]])
    except (ValueError, TypeError, OverflowError):
        return None
    record = replay(file.level, _padded(actions), file.rules)
    solves = succeeds(record.done[: len(actions)], record.goal[: len(actions)])[0]
    return actions[: int(steps_to_goal(record.done)[0])] if solves else None


def _action(value: Any) -> np.ndarray:
    """Convert to an action [6]; raise ValueError if an entry is not one of its choices."""
    action = np.array(value, np.int32)
    if action.shape != (ACTIONS,) or (action < 0).any() or (action >= CHOICES).any():
        raise ValueError
    return action


def _padded(actions: np.ndarray) -> np.ndarray:
    """Pad actions [step, 6] to [256, 6, 1] with doing nothing."""
    padded = np.zeros((RECORD_STEPS, ACTIONS, 1), np.int32)
    padded[: len(actions), :, 0] = actions
    return padded


def empty_file(size: str) -> LevelFile:
    """Return an empty level of a size, with the default rules.

    Raises:
        UserError: no such size, or one without room for a goal.
    """
    try:
        check_size(size_of(size))
        return LevelFile(empty_level(size_of(size), 1), TaskParams())
    except ValueError as error:
        raise UserError(f"{error}.") from None
