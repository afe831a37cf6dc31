"""Both engines behind one interface: a physics step, an env step, or an episode under given actions."""

import hashlib
import json
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from benchmarks import oracle
from benchmarks.contest import Process
from benchmarks.parity.worlds import record_from_kinetix
from levelproof.levelgen.files.kinetix import MANIFOLDS, level_from_kinetix, state_from_kinetix, state_to_kinetix
from levelproof.levelgen.level import Level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import controls
from levelproof.levelgen.task.rules import TaskParams, TaskState
from levelproof.physics.step import step as physics_step
from levelproof.physics.types import Manifold, Params, State
from levelproof.pipeline.runtime import cache_folder

RULES = TaskParams(dense_reward_scale=0.0)  # rewards are -1, 0 and 1
GOES_ON, BROKEN_DOWN = 0, 2  # how an env step leaves an episode that ends neither with goal (1) nor with red (-1)
GEOMETRY = {"normal": "normal", "penetration": "penetration", "point": "collision_point"}


class Stepped(NamedTuple):
    """Results of one physics step."""

    state: State
    normal: Float[np.ndarray, "contact 2 lane"]
    penetration: Float[np.ndarray, "contact lane"]
    point: Float[np.ndarray, "contact 2 lane"]
    control: Float[np.ndarray, "actuator lane"]  # of joints, then thrusters, from the action


class Played(NamedTuple):
    """Env steps with automatic reset; if recorded, the state before each action."""

    reward: Float[np.ndarray, "step lane"]
    done: Bool[np.ndarray, "step lane"]
    record: State | None  # [..., step, lane]

    @property
    def states(self) -> State:
        """The record, which must have been requested."""
        assert self.record is not None
        return self.record


@partial(jax.jit, static_argnames="params")
def _one_step(level: Level, action: Int[Array, "6 lane"], params: Params) -> tuple[State, Manifold, Array, Array]:
    motor, thrust = controls(level, action)
    return *physics_step(level.model, level.state, motor, thrust, params), motor, thrust


@jax.jit
def _env_step(level: Level, action: Int[Array, "6 lane"]) -> tuple[State, Array]:
    now, result = task.advance(level, task.reset(level), action, RULES)
    end = jnp.where(result.reward == 0, BROKEN_DOWN, jnp.sign(result.reward).astype(int))
    return now.state, jnp.where(result.done, end, GOES_ON)


@jax.jit
def _act(level: Level, now: TaskState, action: Int[Array, "6 lane"]):
    return task.step(level, now, action, RULES)


def step_ours(level: Level, action: Int[np.ndarray, "6 lane"], params: Params = RULES.physics) -> Stepped:
    """Take one physics step in every lane."""
    state, manifold, motor, thrust = jax.device_get(_one_step(level, action, params))
    control = np.concatenate([np.broadcast_to(x, (len(x), action.shape[-1])) for x in (motor, thrust)])
    return Stepped(state, manifold.normal, manifold.penetration, manifold.point, control)


def env_step_ours(level: Level, action: Int[np.ndarray, "6 lane"]) -> tuple[State, Int[np.ndarray, " lane"]]:
    """Take one env step in every lane, without reset; return states and ends: 1 goal, -1 red, GOES_ON, BROKEN_DOWN."""
    return jax.device_get(_env_step(level, action))


def play_ours(level: Level, start: State, action: Int[np.ndarray, "step 6 lane"], record: bool) -> Played:
    """Play episodes from `start`; resets lead to the level's own state."""
    level = jax.tree.map(jnp.asarray, level)
    lanes = action.shape[-1]
    now = TaskState(start, jnp.zeros(lanes, jnp.int32), jnp.full(lanes, task.NO_DISTANCE, jnp.float32))
    outcomes, states = [], []
    for one in action:
        if record:
            states.append(jax.tree.map(np.asarray, now.state))
        now, outcome = _act(level, now, one)
        outcomes.append((np.asarray(outcome.reward), np.asarray(outcome.done)))
    reward, done = (np.stack(x) for x in zip(*outcomes, strict=True))
    return Played(reward, done, jax.tree.map(lambda *xs: np.stack(xs, -2), *states) if record else None)


@dataclass
class Reference:
    """The reference for worlds of one size; its process starts at the first request without a cached answer."""

    size: str
    process: Process
    folder: Path  # of the arrays of the current request
    keep: Path | None  # folder of cached answers
    running: bool = False

    @staticmethod
    @contextmanager
    def of(python: Path, size: str, keep: Path | None = None) -> Iterator["Reference"]:
        """Run the reference in the `with` block."""
        cache = cache_folder() / "reference-jax"
        for folder in filter(None, (cache, keep)):
            folder.mkdir(parents=True, exist_ok=True)
        command = [python, oracle.SCRIPTS / "parity.py", "--size", size, "--cache", cache]
        with ExitStack() as stack, tempfile.TemporaryFile("w+") as errors, tempfile.TemporaryDirectory() as folder:
            process = Process([str(argument) for argument in command], oracle.environment(), stack, errors)
            yield Reference(size, process, Path(folder), keep)

    def handmade(self) -> tuple[list[str], Level]:
        """Return names and worlds of the handmade levels of this size, with the impulses stored in them."""
        answer, fields = self._ask("handmade")
        return answer["names"], level_from_kinetix(fields)

    def step(self, level: Level, action: Int[np.ndarray, "6 lane"]) -> Stepped:
        """Take one physics step in every lane."""
        fields = self._ask("step", (level, level.state, action))[1]
        normal, penetration, point = (self._contacts(fields, name) for name in GEOMETRY.values())
        return Stepped(state_from_kinetix(fields), normal, penetration, point, np.moveaxis(fields["control"], 0, -1))

    def play(self, level: Level, start: State, action: Int[np.ndarray, "step 6 lane"], record: bool) -> Played:
        """Play episodes as `play_ours` does, but resets lead to `start`."""
        fields = self._ask("play", (level, start, action), record=record)[1]
        outcome = fields.pop("reward"), fields.pop("done")
        return Played(*outcome, record_from_kinetix(fields) if record else None)

    def _ask(
        self, what: str, worlds: tuple[Level, State, np.ndarray] | None = None, **more: bool
    ) -> tuple[dict, dict[str, np.ndarray]]:
        """Return the answer to a request, and the arrays that come with it."""
        request = {"do": what, **more}
        fields = {} if worlds is None else _fields(*worlds)
        path = self.keep and self.keep / f"{self.size}-{what}-{_digest(request, fields)}.npz"
        out = path or self.folder / "out.npz"
        answer_file = out.with_suffix(".json")
        if not (path and answer_file.is_file()):
            answer_file.write_text(json.dumps(self._answer(request, fields, out)))
        with np.load(out) as file:
            return json.loads(answer_file.read_text()), {name: file[name] for name in file.files}

    def _answer(self, request: dict[str, Any], fields: dict[str, np.ndarray], out: Path) -> dict:
        if not self.running:
            self.process.start()
            self.process.answer()
            self.running = True
        worlds = self.folder / "in.npz"
        np.savez(worlds, **fields)  # pyright: ignore[reportArgumentType]
        self.process.send(json.dumps(request | {"worlds": str(worlds), "out": str(out)}))
        return self.process.answer()

    @staticmethod
    def _contacts(fields: dict[str, np.ndarray], name: str) -> np.ndarray:
        """Reorder contacts as ours: first points of polygon pairs, second points, circle-polygon, circle-circle."""
        polygon, *others = (fields[f"{kind}/{name}"] for kind in MANIFOLDS)
        return np.moveaxis(np.concatenate([polygon[:, :, 0], polygon[:, :, 1], *others], 1), 0, -1)


def _fields(level: Level, start: State, actions: np.ndarray) -> dict[str, np.ndarray]:
    """Convert worlds and actions to the reference's arrays."""
    lanes = actions.shape[-1]
    fields = state_to_kinetix(level, start, np.zeros(lanes, np.int32), np.full(lanes, -1, np.float32))
    return {"actions": actions, **fields}


def _digest(request: dict[str, Any], fields: dict[str, np.ndarray]) -> str:
    """Hash a request and the script that answers it."""
    text = hashlib.sha256(json.dumps(request).encode())
    text.update((oracle.SCRIPTS / "parity.py").read_bytes())
    text.update("\n".join(oracle.REQUIREMENTS).encode())
    for name in sorted(fields):
        text.update(f"{name} {fields[name].dtype} {fields[name].shape}".encode())
        text.update(np.ascontiguousarray(fields[name]).tobytes())
    return text.hexdigest()[:16]
