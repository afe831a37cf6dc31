"""One physics step from each of many states, in both engines."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Int

from benchmarks.parity.causes import Step, find_cause
from benchmarks.parity.distance import OFF, UNITS, Distances, distances
from benchmarks.parity.engines import RULES, Stepped, step_ours
from benchmarks.parity.worlds import BLOCK, joined, lanes_of, starting_in
from levelproof.levelgen.batching import blocks
from levelproof.levelgen.level import Level
from levelproof.physics.types import State

LIMITS = (1e-6, 1e-5, 1e-4, 1e-3)
DEFECT_OFF = (1e-4, 1e-2)


@dataclass(frozen=True)
class Pool:
    """Worlds, one per lane, in their levels' initial states, with one action each or one per step."""

    level: Level
    action: Int[np.ndarray, "*step 6 lane"]
    scene: list[str]
    origin: list[str]  # the world's source, for messages

    def __len__(self) -> int:
        return len(self.scene)

    def lanes(self, lanes: Int[np.ndarray, " some"]) -> "Pool":
        level, action = lanes_of((self.level, self.action), lanes)
        return Pool(level, action, [self.scene[k] for k in lanes], [self.origin[k] for k in lanes])


@dataclass(frozen=True)
class FieldRow:
    """Differences of one field over all states."""

    field: str
    unit: str
    median: float
    p99: float
    p999: float
    largest: float
    above: int  # states off by more than 1e-3


@dataclass(frozen=True)
class SceneRow:
    """Largest differences of positions and speeds over the states of a scene."""

    scene: str
    states: int
    within: list[float]  # share of the states within each of LIMITS
    median: float
    largest: float
    other_contacts: int  # number of states whose active contacts differ
    off: int  # number of states to investigate


@dataclass(frozen=True)
class OffState:
    """A state that is off by more than 1e-3, and why."""

    scene: str
    origin: str
    by: dict[str, float]  # difference of each field that is off, by name
    other_contacts: int
    cause: str
    explained: bool
    moved: int  # units in the last place by which our neighbours were perturbed
    spread: float  # of the neighbours' positions and speeds
    motion: float  # largest difference of a position or speed


@dataclass(frozen=True)
class DefectRow:
    """Changes of positions and speeds after one step of ours if the padding defect is fixed."""

    states: int
    differ: list[int]  # number of states that differ by more than each of DEFECT_OFF
    largest: float


@dataclass(frozen=True)
class OneStep:
    """One-step results of one size."""

    states: int
    fields: list[FieldRow]
    scenes: list[SceneRow]  # the last row covers all scenes
    off: list[OffState]
    causes: dict[str, int]
    defect: DefectRow


def pool_of(pools: Sequence[Pool]) -> Pool:
    level, action = joined([(pool.level, pool.action) for pool in pools])
    return Pool(level, action, [x for pool in pools for x in pool.scene], [x for pool in pools for x in pool.origin])


def distinct(pool: Pool) -> Pool:
    """Drop duplicate worlds: a level whose episode ends at once returns to its start again and again."""
    leaves = [np.asarray(x).reshape(-1, len(pool)).T for x in jax.tree.leaves((pool.level, pool.action))]
    worlds = (b"".join(np.ascontiguousarray(x[lane]).tobytes() for x in leaves) for lane in range(len(pool)))
    first: dict[bytes, int] = {}
    for lane, world in enumerate(worlds):
        first.setdefault(hashlib.sha256(world).digest(), lane)
    return pool.lanes(np.array([*first.values()]))


def picked(played: Pool, record: State, times: Int[np.ndarray, "pick lane"]) -> Pool:
    """Pick the states at `times` of played lanes: actions [step, 6, lane], record [..., step, lane]."""
    lane, time = np.broadcast_to(np.arange(times.shape[1]), times.shape).ravel(), times.ravel()
    chosen = played.lanes(lane)
    return Pool(
        level=starting_in(chosen.level, jax.tree.map(lambda x: x[..., time, lane], record)),
        action=np.take_along_axis(chosen.action, time[None, None], 0)[0],
        scene=chosen.scene,
        origin=[f"{name}, env step {step}" for name, step in zip(chosen.origin, time, strict=True)],
    )


def one_step(pool: Pool, step_theirs: Step, tick: Callable[[str], None]) -> OneStep:
    """Step the pool in both engines; find the causes of states that are off."""
    parts, off, defect = [], [], []
    for lanes in blocks(len(pool), BLOCK):
        block, count = pool.lanes(lanes), int(lanes[-1] - lanes[0]) + 1  # the last block is padded
        theirs, ours = step_theirs(block.level, block.action), step_ours(block.level, block.action)
        fixed = step_ours(block.level, block.action, replace(RULES.physics, faithful_padding=False))
        apart = distances(block.level, ours, theirs)
        parts.append(_first(apart, count))
        defect.append(distances(block.level, fixed, ours).motion[:count])
        off += [
            _look_into(block.lanes(np.array([lane])), lanes_of(theirs, [lane]), _lane(apart, lane))
            for lane in np.flatnonzero(apart.off[:count]).tolist()
        ]
        tick("states")
    apart = Distances(
        {name: np.concatenate([part.by_field[name] for part in parts]) for name in UNITS},
        np.concatenate([part.contacts for part in parts]),
    )
    names = [state.cause for state in off]
    return OneStep(
        states=len(pool),
        fields=[_field(name, apart.by_field[name]) for name in UNITS],
        scenes=[*_scenes(np.array(pool.scene), apart)],
        off=off,
        causes={name: names.count(name) for name in sorted(set(names), key=names.count, reverse=True)},
        defect=_defect(np.concatenate(defect)),
    )


def _look_into(state: Pool, theirs: Stepped, apart: Distances) -> OffState:
    """Investigate a pool of one state."""
    cause = find_cause(step_ours, state.level, state.action, theirs)
    return OffState(
        scene=state.scene[0],
        origin=state.origin[0],
        by={name: float(x[0]) for name, x in apart.by_field.items() if x[0] > OFF},
        motion=float(apart.motion[0]),
        other_contacts=int(apart.contacts[0]),
        cause=cause.name,
        explained=cause.explained,
        moved=cause.moved,
        spread=cause.spread,
    )


def _lane(apart: Distances, lane: int) -> Distances:
    return Distances({name: x[[lane]] for name, x in apart.by_field.items()}, apart.contacts[[lane]])


def _first(apart: Distances, count: int) -> Distances:
    return Distances({name: x[:count] for name, x in apart.by_field.items()}, apart.contacts[:count])


def _field(name: str, x: np.ndarray) -> FieldRow:
    median, p99, p999, largest = (float(y) for y in np.quantile(x, (0.5, 0.99, 0.999, 1), method="lower"))
    return FieldRow(name, UNITS[name], median, p99, p999, largest, int((x > LIMITS[-1]).sum()))


def _scenes(scene: np.ndarray, apart: Distances) -> Iterator[SceneRow]:
    for name in [*dict.fromkeys(scene.tolist()), "all"]:
        here = (scene == name) | (name == "all")
        motion = apart.motion[here]
        yield SceneRow(
            name,
            int(here.sum()),
            [float((motion < limit).mean()) for limit in LIMITS],
            float(np.median(motion)),
            float(motion.max()),
            int((apart.contacts[here] > 0).sum()),
            int(apart.off[here].sum()),
        )


def _defect(motion: np.ndarray) -> DefectRow:
    return DefectRow(len(motion), [int((motion > limit).sum()) for limit in DEFECT_OFF], float(motion.max()))
