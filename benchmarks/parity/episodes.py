"""Whole episodes: the same levels and actions in both engines, and why outcomes differ.

Contacts are chaotic: each of them amplifies a difference in the last bit. So each engine also plays against itself,
from starts in which every number of a movable body is perturbed by at most one unit in its last place. How often the
reference disagrees with itself is what any other engine must expect.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Bool, Int

from benchmarks.parity.causes import MOVES, is_broken, near_worlds, reached
from benchmarks.parity.distance import MOTION, OFF, evolving_gaps, gap, largest
from benchmarks.parity.engines import BROKEN_DOWN, GOES_ON, Played, Reference, env_step_ours, play_ours
from benchmarks.parity.onestep import Pool
from benchmarks.parity.scenes import movable
from benchmarks.parity.worlds import BLOCK, lanes_of, nudged_tree, starting_in
from levelproof.levelgen.level import Level
from levelproof.physics.types import State

STEPS = 256  # env steps; by then every first episode has ended
TARGETS = {"s": 0.97, "m": 0.95, "l": 0.9}  # minimum share of pairs with equal outcomes
COPIES = 32  # starts near that of a pair whose outcomes differ, itself included
FIRST_OFF = (1e-4, 1e-2)  # m, rad

NEAR_STARTS_PART = "starts one unit in the last place away part as well"
STEPS_AGREE = "every env step agrees from the reference's own states; rounding adds up"
STEP_AMPLIFIES = "one env step amplifies rounding as much"
NOT_EXPLAINED = "NOT EXPLAINED"
NAMES = {-1: "red", 0: "time", 1: "goal"}


@dataclass(frozen=True)
class Outcome:
    """The first episode's end, by lane."""

    step: Int[np.ndarray, " lane"]  # env step, from 0
    reward: Int[np.ndarray, " lane"]  # -1, 0, 1

    def same(self, other: "Outcome") -> Bool[np.ndarray, " lane"]:
        return (self.step == other.step) & (self.reward == other.reward)

    def text(self, lane: int) -> str:
        return f"{NAMES[int(self.reward[lane])]} at {self.step[lane] + 1}"


@dataclass(frozen=True)
class Parted:
    """A pair whose outcomes differ."""

    scene: str
    origin: str
    ours: str
    theirs: str
    first_off: list[int | None]  # env step from which on positions differ by each of FIRST_OFF
    at_contact: bool  # whether contacts came, went or differed in the first of these steps
    near_starts: int  # number of COPIES - 1 near starts with another outcome in our engine
    step_off: float  # largest difference of an env step of ours from the reference's states
    reason: str


@dataclass(frozen=True)
class Episodes:
    """Pairs of episodes of one size, played in both engines: counts and shares of equal outcomes."""

    pairs: int
    touched: int  # number that end by touching blue or red in the reference
    same: float  # share with equal outcomes in both engines
    same_touched: float | None  # likewise, of those that end by touching
    reference_itself: float  # share with equal outcomes in the reference from a near start
    ours_itself: float
    target: float | None
    parted: list[Parted]
    reasons: dict[str, int]


@dataclass(frozen=True)
class Block:
    """Results of a block of pairs."""

    theirs: Outcome
    same: Bool[np.ndarray, " pair"]
    reference_itself: Bool[np.ndarray, " pair"]
    ours_itself: Bool[np.ndarray, " pair"]
    parted: list[Parted]
    record: State  # the reference's


def outcome(played: Played) -> Outcome:
    step = np.argmax(played.done, 0)
    return Outcome(step, np.sign(np.take_along_axis(played.reward, step[None], 0)[0]).astype(int))


def near(level: Level, rng: np.random.Generator) -> State:
    """Perturb the initial state: every number of movable bodies by at most one unit in its last place."""
    free, moved = movable(level), nudged_tree(level.state, rng)
    keep = lambda old, new: np.where(free if old.ndim == 2 else free[:, None], new, old)
    return replace(level.state, **{name: keep(getattr(level.state, name), getattr(moved, name)) for name in MOTION})


def play_block(pairs: Pool, count: int, reference: Reference, tick: Callable[[str], None]) -> Block:
    """Play BLOCK pairs and compare the first `count`."""
    level, action = pairs.level, pairs.action
    other = near(level, np.random.default_rng(0))
    theirs = reference.play(level, level.state, action, record=True)
    tick("episodes of the reference")
    theirs_near = reference.play(level, other, action, record=False)
    tick("episodes of the reference from near starts")
    ours = play_ours(level, level.state, action, record=True)
    ours_near = play_ours(level, other, action, record=False)
    tick("episodes of ours")
    a, b = outcome(ours), outcome(theirs)
    lanes = np.flatnonzero(~a.same(b)[:count])
    near_starts = _near_starts(level, action, lanes, a)
    parted = [
        _part(pairs.lanes(np.array([lane])), lane, ours.states, theirs.states, a, b, others)
        for lane, others in zip(lanes.tolist(), near_starts, strict=True)
    ]
    return Block(
        Outcome(b.step[:count], b.reward[:count]),
        a.same(b)[:count],
        b.same(outcome(theirs_near))[:count],
        a.same(outcome(ours_near))[:count],
        parted,
        theirs.states,
    )


def summed(size: str, parts: list[Block]) -> Episodes:
    join = lambda name: np.concatenate([getattr(part, name) for part in parts])
    reward = np.concatenate([part.theirs.reward for part in parts])
    same, touched = join("same"), reward != 0
    parted = [one for part in parts for one in part.parted]
    reasons = [one.reason for one in parted]
    return Episodes(
        pairs=len(same),
        touched=int(touched.sum()),
        same=float(same.mean()),
        same_touched=float(same[touched].mean()) if touched.any() else None,
        reference_itself=float(join("reference_itself").mean()),
        ours_itself=float(join("ours_itself").mean()),
        target=TARGETS.get(size),
        parted=parted,
        reasons={name: reasons.count(name) for name in dict.fromkeys(reasons)},
    )


def _part(pair: Pool, lane: int, ours: State, theirs: State, a: Outcome, b: Outcome, near_starts: int) -> Parted:
    """Investigate a pair, given records of its block, [..., step, lane]."""
    until = int(min(a.step[lane], b.step[lane])) + 1  # states before each action of both first episodes
    first, at_contact = _first_off(*(_until(states, lane, until) for states in (ours, theirs)))
    last = int(b.step[lane])
    end = int(b.reward[lane]) or (GOES_ON if last + 1 == STEPS else BROKEN_DOWN)
    step_off, reason = _steps(pair.level, _until(theirs, lane, last + 1), pair.action, end)
    if near_starts and reason != NOT_EXPLAINED:
        reason = NEAR_STARTS_PART
    return Parted(
        scene=pair.scene[0],
        origin=pair.origin[0],
        ours=a.text(lane),
        theirs=b.text(lane),
        first_off=first,
        at_contact=at_contact,
        near_starts=near_starts,
        step_off=step_off,
        reason=reason,
    )


def _until(states: State, lane: int, end: int) -> State:
    """Return the states of one lane before each of its first `end` actions, as lanes."""
    return jax.tree.map(lambda x: np.ascontiguousarray(x[..., :end, lane]), states)


def _first_off(ours: State, theirs: State) -> tuple[list[int | None], bool]:
    """Return when positions first differ by FIRST_OFF, and whether a contact came, went or differed at the first."""
    apart = np.maximum(*(largest(gap(getattr(ours, name), getattr(theirs, name))) for name in MOTION[:2]))
    first = [int(np.argmax(apart > limit)) if (apart > limit).any() else None for limit in FIRST_OFF]
    if first[0] is None:
        return first, False
    x, y, step = ours.contact_active, theirs.contact_active, first[0]
    before = max(step - 1, 0)
    events = (x[:, step] != y[:, step]) | (x[:, step] != x[:, before]) | (y[:, step] != y[:, before])
    return first, bool(events.any())


def _near_starts(level: Level, action: np.ndarray, lanes: np.ndarray, ours: Outcome) -> list[int]:
    """Count, for each lane, those of its COPIES - 1 near starts whose outcome differs from `ours`."""
    counts, rng, per_block = [], np.random.default_rng(1), BLOCK // COPIES
    for first in range(0, len(lanes), per_block):
        chosen = lanes[first : first + per_block]
        lane = np.resize(np.repeat(chosen, COPIES), BLOCK)
        copies = lanes_of(level, lane)
        played = play_ours(copies, near(copies, rng), action[:, :, lane], record=False)
        other = ~outcome(played).same(Outcome(ours.step[lane], ours.reward[lane]))
        counts += other.reshape(-1, COPIES)[: len(chosen), 1:].sum(1).tolist()
    return counts


def _steps(level: Level, states: State, action: np.ndarray, end: int) -> tuple[float, str]:
    """Take our env step from each state of the reference; return the largest difference of states, and the reason.

    Args:
        level: one lane.
        states: the reference's, one env step a lane; at most BLOCK. It ends the episode after the last.
        action: [step, 6, 1].
        end: how it ends there, as in `env_step_ours`.
    """
    last = states.rotation.shape[-1] - 1
    lane = np.minimum(np.arange(BLOCK), last)
    worlds = starting_in(lanes_of(level, np.zeros(BLOCK, int)), lanes_of(states, lane))
    theirs = lanes_of(states, np.minimum(lane + 1, last))
    after, ends = env_step_ours(worlds, action[lane, :, 0].T)
    gaps = evolving_gaps(after, theirs)
    apart = np.where(lane < last, np.max([largest(gaps[name]) for name in MOTION], 0), 0)  # the last state is unknown
    their_ends = np.where(lane < last, GOES_ON, end)

    def explained(k: int, is_like: Callable[[State, np.ndarray], bool]) -> bool:
        """Whether worlds near the reference's do as it does after its k-th state, or it has broken down there."""
        if is_broken(*lanes_of((states, theirs), [k])):
            return True
        world, action_there = lanes_of(worlds, [k]), np.repeat(action[lane[k]], BLOCK, 1)
        return any(is_like(*env_step_ours(near_worlds(world, most), action_there)) for most in MOVES)

    worst = int(np.argmax(apart))
    differs = [k for k in np.flatnonzero(ends != their_ends).tolist() if k <= last]
    answers = [explained(k, lambda _, ended, k=k: their_ends[k] in ended) for k in differs]
    if apart[worst] > OFF:
        answers.append(explained(worst, lambda state, _: reached(state, lanes_of(theirs, [worst]))))
    if not all(answers):
        return float(apart[worst]), NOT_EXPLAINED
    return float(apart[worst]), STEP_AMPLIFIES if answers else STEPS_AGREE
