"""Children of levels by random edits, for curricula that evolve levels.

A child is its parent after a few edits of `levelgen.edit`, the editor's, with random arguments. An edit that the level
does not allow is redrawn; `playable` marks the children that can be played. Numpy on the host, except for the physics.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from levelproof.levelgen.batching import take
from levelproof.levelgen.edit import (
    ACTUATORS,
    MAX_REACH,
    SHAPES,
    EditError,
    add_body,
    add_joint,
    add_thruster,
    bind,
    delete,
    fix,
    move,
    one_of,
    resize,
    set_role,
    turn,
)
from levelproof.levelgen.level import (
    ACTIONS,
    WORLD_SIDE,
    Level,
    Role,
    concatenate_levels,
)
from levelproof.levelgen.proofs import driven
from levelproof.levelgen.sampling.scenery import FLOOR_TOP
from levelproof.levelgen.task.rules import TaskParams, advance, has_nan, reset
from levelproof.physics.types import FIXED_POLYGONS

MAX_TRIES = 20  # attempts to draw an edit that the level allows
STEP = 0.5  # m, standard deviation of a move along either axis
MAX_FACTOR = 1.5  # by which an edit enlarges or shrinks a body
FIRST_STEPS = 2  # physics steps, at most, after which a level must be calm
MAX_SPEED = 3.0  # m/s after these; 99% of sampled levels have no faster body

Draw = Callable[[Level, np.random.Generator], Level]  # an edit with random arguments


def children_of(
    parents: Level, rng: np.random.Generator, edits: int, rules: TaskParams
) -> tuple[Level, Bool[np.ndarray, " lane"]]:
    """Return a child of each parent, and which of them can be played.

    Args:
        parents: levels of one size; level axis last.
        rng: numpy's generator; advanced.
        edits: number of edits from parent to child.
        rules: the task's rules.
    """
    parents = jax.tree.map(np.asarray, parents)
    children = concatenate_levels([child_of(take(parents, np.array([i])), rng, edits) for i in range(len(parents))])
    return children, np.asarray(playable(children, rules))


def child_of(parent: Level, rng: np.random.Generator, edits: int) -> Level:
    """Apply random edits to a level of one lane."""
    for _ in range(edits):
        parent = _edited(parent, rng)
    return parent


def _edited(level: Level, rng: np.random.Generator) -> Level:
    for _ in range(MAX_TRIES):
        try:
            return DRAWS[int(rng.integers(len(DRAWS)))](level, rng)
        except EditError:
            continue
    return level


@jax.jit(static_argnames="rules")
def playable(level: Level, rules: TaskParams) -> Bool[Array, " lane"]:
    """Find levels that can be played: complete, inside the room, and calm at first.

    They have a green, a blue and a driven body, and the centres of all bodies lie in the room. FIRST_STEPS without
    actions neither end the episode nor leave a body faster than MAX_SPEED; this excludes most overlaps, since the
    engine flings overlapping bodies apart.
    """
    model, role = level.model, jnp.where(level.model.active, level.role, Role.PLAIN)
    rules = replace(rules, frame_skip=min(rules.frame_skip, FIRST_STEPS))
    after, result = advance(level, reset(level), jnp.zeros((ACTIONS, role.shape[-1]), jnp.int32), rules)
    place = level.state.position[FIXED_POLYGONS:]
    inside = ((place >= 0) & (place <= WORLD_SIDE)).all(1) | ~model.active[FIXED_POLYGONS:]
    slow = jnp.linalg.norm(after.state.velocity, axis=1) <= MAX_SPEED
    has_goal = (role == Role.GREEN).any(0) & (role == Role.BLUE).any(0)
    calm = inside.all(0) & (slow | ~model.active).all(0) & ~result.done & ~has_nan(after.state)
    return has_goal & driven(level).any(0) & calm


def _add_body(level: Level, rng: np.random.Generator) -> Level:
    x, y = rng.uniform((0.0, FLOOR_TOP), WORLD_SIDE)
    return add_body(level, str(rng.choice(["circle", *SHAPES])), x, y)


def _move(level: Level, rng: np.random.Generator) -> Level:
    body = _body(level, rng)
    return move(level, body, *(one_of(level).state.position[body] + rng.normal(0, STEP, 2)))


def _turn(level: Level, rng: np.random.Generator) -> Level:
    return turn(level, _body(level, rng), rng.uniform(-np.pi, np.pi))


def _resize(level: Level, rng: np.random.Generator) -> Level:
    return resize(level, _body(level, rng), MAX_FACTOR ** rng.uniform(-1, 1))


def _exchange_roles(level: Level, rng: np.random.Generator) -> Level:
    """Exchange the roles of two bodies."""
    a, b = (_body(level, rng) for _ in range(2))
    if _role(level, a) == _role(level, b):
        raise EditError("The bodies have equal roles.")
    return set_role(set_role(level, a, _role(level, b)), b, _role(level, a))


def _redden(level: Level, rng: np.random.Generator) -> Level:
    """Make a plain body red, or a red one plain."""
    body = _body(level, rng)
    other = {Role.PLAIN: Role.RED, Role.RED: Role.PLAIN}.get(_role(level, body))
    if other is None:
        raise EditError("A green or blue body keeps its role.")
    return set_role(level, body, other)


def _fix(level: Level, rng: np.random.Generator) -> Level:
    body = _body(level, rng)
    return fix(level, body, bool(one_of(level).model.inverse_mass[body]))


def _join(level: Level, rng: np.random.Generator) -> Level:
    """Move a body next to another, and join the two uppermost bodies there."""
    a, b = (_body(level, rng) for _ in range(2))
    if a == b:
        raise EditError("A joint holds two bodies together.")
    angle = rng.uniform(-np.pi, np.pi)
    away = rng.uniform(0, MAX_REACH / 2)
    x, y = one_of(level).state.position[a] + away * np.array((np.cos(angle), np.sin(angle)))
    return add_joint(move(level, b, x, y), x, y, fixed=bool(rng.integers(2)))


def _add_thruster(level: Level, rng: np.random.Generator) -> Level:
    x, y = one_of(level).state.position[_body(level, rng)]
    return add_thruster(level, x, y, rng.uniform(-np.pi, np.pi))


def _bind(level: Level, rng: np.random.Generator) -> Level:
    kind = ("joint", "thruster")[rng.integers(2)]
    row, bindings = _one_of_kind(level, kind, rng), ACTUATORS[kind].bindings(level)
    return bind(level, kind, row, int(bindings[row, 0]) + int(rng.integers(1, ACTUATORS[kind].entries)))


def _delete(level: Level, rng: np.random.Generator) -> Level:
    kind = ("body", "joint", "thruster")[rng.integers(3)]
    return delete(level, kind, _body(level, rng) if kind == "body" else _one_of_kind(level, kind, rng))


DRAWS: Sequence[Draw] = (
    _add_body, _move, _turn, _resize, _exchange_roles, _redden, _fix, _join, _add_thruster, _bind, _delete
)  # fmt: skip


def _body(level: Level, rng: np.random.Generator) -> int:
    """Draw an active body that is not scenery."""
    return _chosen(np.flatnonzero(np.asarray(level.model.active)[FIXED_POLYGONS:]) + FIXED_POLYGONS, "body", rng)


def _role(level: Level, body: int) -> Role:
    return Role(int(level.role[body, 0]))


def _one_of_kind(level: Level, kind: str, rng: np.random.Generator) -> int:
    return _chosen(np.flatnonzero(np.asarray(ACTUATORS[kind].active(level))), kind, rng)


def _chosen(rows: Any, kind: str, rng: np.random.Generator) -> int:
    if not len(rows):
        raise EditError(f"There is no {kind}.")
    return int(rng.choice(rows))
