"""Why a state is off: whether rounding explains it, and what amplifies the rounding.

Both engines compute in single precision, but add in different orders. So a state that is off is stepped again from
COPIES neighbours, every number perturbed by at most one unit in its last place (then by more: MOVES). If our own
results spread as far as the reference's, number by number, no engine in single precision can do better. The amplifier
is named by what else differs among the neighbours (contacts that come and go, normals that turn), by what happens
without the joints' limits, and by what holds the body that is off.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Int

from benchmarks.parity.distance import CONTACT_IMPULSES, JOINT_IMPULSES, MOTION, OFF, evolving_gaps
from benchmarks.parity.engines import Stepped
from benchmarks.parity.worlds import BLOCK, contact_bodies, lanes_of, nudged_tree
from levelproof.levelgen.level import Level
from levelproof.physics.pairs import pairs_of
from levelproof.physics.types import State

COPIES = BLOCK  # neighbours, the state itself first
MOVES = (1, 4, 16)  # units in the last place
BROKEN = 1e6  # rad or m; a world with larger numbers has broken down
TURNED = 1e-3  # change of a unit normal, or of a contact point, m; exceeds rounding of a well-defined one
SMALL = 60.0  # 1/(kg m^2); small changes of impulses spin a body with more inverse inertia
DEEP = 0.1  # m of overlap
RESTING = 0.01  # rad/s
SPINNING = 5.0  # rad/s
FAST = 20.0  # m/s
Step = Callable[[Level, Int[np.ndarray, "6 lane"]], Stepped]

BROKEN_WORLD = "broken world"
TOUCHING = "touching or not"
SEPARATING_AXIS = "tie in the separating axis"
DEEPEST_VERTEX = "tie of the deepest vertices"
NEAREST_EDGE = "tie of the nearest edges"
CENTRES = "coincident circles"
LIMIT_AT_REST = "limit at rest"
LIMIT = "limit that is left or not"
CIRCLE_DEEP = "circle deep in a polygon"
DEEP_BODIES = "bodies deep in each other"
SMALL_BODY = "small body held by several contacts"
CHAIN = "bodies joined in a chain"
HELD_BODY = "bodies held by several contacts"
IMPACT = "fast impact"
SPIN = "fast spin"
UNNAMED = "rounding of no named kind"


@dataclass(frozen=True)
class Cause:
    """Why one state is off."""

    explained: bool  # our neighbours spread as far as the reference
    name: str
    moved: int  # units in the last place by which neighbours were perturbed
    spread: float  # of the neighbours' motion


class Neighbours(NamedTuple):
    """Neighbours of one state, one per lane, after a step; the state itself is the first."""

    level: Level
    after: Stepped


def find_cause(step: Step, level: Level, action: Int[np.ndarray, "6 1"], theirs: Stepped) -> Cause:
    """Find the cause of one state that is off.

    Args:
        step: our physics step of BLOCK lanes.
        level: one lane, stepped from its `state`.
        theirs: the reference's result, one lane.
    """
    *earlier, most = MOVES
    for moved in earlier:
        copies = neighbours(step, level, action, moved)
        if reached(copies.after.state, theirs.state):
            return Cause(True, name_cause(step, copies, action, theirs), moved, spread(copies.after.state))
    copies = neighbours(step, level, action, most)
    explained = reached(copies.after.state, theirs.state) or is_broken(level.state, theirs.state)
    return Cause(explained, name_cause(step, copies, action, theirs), most, spread(copies.after.state))


def neighbours(step: Step, level: Level, action: Int[np.ndarray, "6 1"], most: int) -> Neighbours:
    """Step worlds near that of one lane."""
    level = near_worlds(level, most)
    return Neighbours(level, step(level, np.repeat(action, COPIES, -1)))


def near_worlds(level: Level, most: int) -> Level:
    """Perturb every float of a lane's state by at most `most` units in its last place; above 1, of its model too.

    The first of the COPIES lanes is the world itself.
    """
    level = lanes_of(level, np.zeros(COPIES, int))
    moved = nudged_tree((level.state, level.model), np.random.default_rng(0), most)
    state, model = jax.tree.map(_first_stays, (level.state, level.model), moved)
    return replace(level, state=state, model=model if most > 1 else level.model)


def _first_stays(old: np.ndarray, new: np.ndarray) -> np.ndarray:
    return np.concatenate([old[..., :1], new[..., 1:]], -1)


def reached(ours: State, theirs: State) -> bool:
    """Whether each number of the reference lies among our neighbours', or no farther outside than these spread."""
    for name, far in evolving_gaps(ours, theirs).items():
        x, y = getattr(ours, name), getattr(theirs, name)
        with np.errstate(invalid="ignore", over="ignore"):
            wide = (x.max(-1) - x.min(-1)) / (1 if name in MOTION else 1 + np.abs(y[..., 0]))
        if not ((far.min(-1) <= OFF) | (far.min(-1) <= wide)).all():
            return False
    return bool((ours.contact_active == theirs.contact_active).any(-1).all())


def is_broken(*states: State) -> bool:
    return any(not (np.abs(getattr(state, name)) < BROKEN).all() for state in states for name in MOTION)


def spread(states: State) -> float:
    """Return the widest range of any position or speed among neighbours."""
    with np.errstate(invalid="ignore", over="ignore"):
        return float(max(np.ptp(getattr(states, name), axis=-1).max() for name in MOTION))


def name_cause(step: Step, copies: Neighbours, action: Int[np.ndarray, "6 1"], theirs: Stepped) -> str:
    """Name the first kind that fits: decisions by the last bit before mere amplifiers."""
    before = lanes_of(copies.level, [0])
    ours = lanes_of(copies.after, [0])
    if is_broken(before.state, theirs.state, ours.state):
        return BROKEN_WORLD
    if (ours.state.contact_active != theirs.state.contact_active).any():
        return TOUCHING
    bodies = Bodies.off(before, ours, theirs)
    return (
        _flipped_contact(before, bodies, copies.after, theirs)
        or _limit(step, copies, action, bodies)
        or _deep(before, bodies, ours)
        or _held(before, bodies)
    )


@dataclass(frozen=True)
class Bodies:
    """The bodies and contacts that a difference involves, in one world."""

    worst: int  # the movable body that is off most
    group: Bool[np.ndarray, " body"]  # bodies that it touches or is joined to, directly or through others
    contacts: Bool[np.ndarray, " contact"]  # contacts that act on the group

    @staticmethod
    def off(before: Level, ours: Stepped, theirs: Stepped) -> "Bodies":
        model, movable = before.model, (before.model.inverse_mass != 0)[:, 0]
        a, b = contact_bodies(before.size)
        gaps = evolving_gaps(ours.state, theirs.state)
        largest_of = lambda names: np.max([gaps[name].reshape(len(gaps[name]), -1).max(-1) for name in names], 0)
        apart = largest_of(MOTION)
        if apart.max() <= OFF:  # impulses only
            for ends, gap in ((a, largest_of(CONTACT_IMPULSES)), (b, largest_of(CONTACT_IMPULSES))):
                np.maximum.at(apart, ends, gap)
            for ends in (model.joint_a[:, 0], model.joint_b[:, 0]):
                np.maximum.at(apart, ends, largest_of(JOINT_IMPULSES))
        worst = int(np.argmax(np.where(movable, apart, -1)))
        active = (ours.state.contact_active | theirs.state.contact_active)[:, 0]
        acts = active & model.collides[a, b, 0]
        edges = [*zip(a[acts], b[acts], strict=True)]
        joined = model.joint_active[:, 0]
        edges += [*zip(model.joint_a[joined, 0], model.joint_b[joined, 0], strict=True)]
        group = np.arange(len(movable)) == worst
        for _ in range(len(movable)):
            for one, other in edges:
                if movable[one] and movable[other] and (group[one] or group[other]):
                    group[one] = group[other] = True
        return Bodies(worst, group, active & (group[a] | group[b]))


def _flipped_contact(before: Level, bodies: Bodies, after: Stepped, theirs: Stepped) -> str | None:
    """Blame a contact that some neighbour or the reference finds differently."""
    everyone = jax.tree.map(lambda x, y: np.concatenate([x, y], -1), after, theirs)
    active = everyone.state.contact_active
    a, b = contact_bodies(before.size)
    near = bodies.group[a] | bodies.group[b]
    if (near & (active.any(-1) != active.all(-1))).any():
        return TOUCHING
    with np.errstate(invalid="ignore"):
        turned = np.ptp(everyone.normal, axis=-1).max(1) > TURNED
        slid = np.ptp(everyone.point, axis=-1).max(1) > TURNED
    pairs = pairs_of(before.size)
    n, m = len(pairs.polygon), len(pairs.circle_polygon)
    index = np.arange(len(a))
    kinds = (
        (SEPARATING_AXIS, turned & (index < 2 * n)),
        (DEEPEST_VERTEX, slid & (index < 2 * n)),
        (NEAREST_EDGE, (turned | slid) & (index >= 2 * n) & (index < 2 * n + m)),
        (CENTRES, turned & (index >= 2 * n + m)),
    )
    return next((name for name, flips in kinds if (flips & bodies.contacts).any()), None)


def _limit(step: Step, copies: Neighbours, action: np.ndarray, bodies: Bodies) -> str | None:
    """Blame joints beyond their limits, if neighbours stay together without these limits."""
    model, state = copies.level.model, copies.level.state
    a, b = model.joint_a[:, 0], model.joint_b[:, 0]
    angle = (state.rotation[b] - state.rotation[a] - model.joint_rotation)[:, 0]
    beyond = (angle <= model.joint_min[:, 0]) | (angle >= model.joint_max[:, 0])
    held = (model.joint_active & ~model.joint_fixed & model.joint_limited)[:, 0] & (bodies.group[a] | bodies.group[b])
    if not (held & beyond).any():
        return None
    free = replace(copies.level, model=replace(model, joint_limited=model.joint_limited & ~(held & beyond)[:, None]))
    if spread(step(free, np.repeat(action, COPIES, -1)).state) > spread(copies.after.state) / 10:
        return None
    turning = np.abs(state.angular_velocity[b] - state.angular_velocity[a])[held & beyond, 0]
    return LIMIT_AT_REST if turning.min() < RESTING else LIMIT


def _deep(before: Level, bodies: Bodies, ours: Stepped) -> str | None:
    """Blame deep overlaps, whose correction takes impulses that are large beside the remaining motion."""
    pairs = pairs_of(before.size)
    n, m = len(pairs.polygon), len(pairs.circle_polygon)
    a, b = contact_bodies(before.size)
    acts = bodies.contacts & before.model.collides[a, b, 0]
    depth = np.where(acts, ours.penetration[:, 0], 0)
    circle = slice(2 * n, 2 * n + m)
    radius = before.model.radius[a[circle] - before.size.polygons, 0]
    if (acts[circle] & (depth[circle] > 0.99 * radius)).any():
        return CIRCLE_DEEP
    return DEEP_BODIES if (depth > DEEP).any() else None


def _held(before: Level, bodies: Bodies) -> str:
    """Blame what holds the body that is off, or its motion."""
    model, worst = before.model, bodies.worst
    a, b = contact_bodies(before.size)
    acts = bodies.contacts & model.collides[a, b, 0]
    ends = np.stack([model.joint_a[:, 0], model.joint_b[:, 0]])
    joined = model.joint_active[:, 0] & bodies.group[ends].any(0)
    holds = (acts & ((a == worst) | (b == worst))).sum() + (joined & (ends == worst).any(0)).sum()
    if holds > 1 and model.inverse_inertia[worst, 0] > SMALL:
        return SMALL_BODY
    if joined.sum() > 1:
        return CHAIN
    if acts.sum() > 1:
        return HELD_BODY
    if np.abs(before.state.angular_velocity[bodies.group]).max() > SPINNING:
        return SPIN
    return IMPACT if np.abs(before.state.velocity[bodies.group]).max() > FAST else UNNAMED
