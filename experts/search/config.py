"""How a level is searched."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Int

from levelproof.experts.config import MAX_COUNTED
from levelproof.physics.bounds import require

MAX_ROUNDS = 1024  # of what a success gets afterwards
MAX_RUNGS = 16  # each is four times the one before, and env steps are counted in 32 bits
MAX_ENTRIES = 16_384  # sums of their weights (`experts.search.archive`) are counted in 32 bits


class StopLimits(NamedTuple):
    """Of a SearchConfig what says when a search ends: data of its program, so that other numbers need no other one."""

    env_steps: Int[Array, ""]
    variations: Int[Array, ""]
    patience: Int[Array, ""]
    per_cell: Int[Array, ""]
    rungs: Int[Array, " rung"]  # env steps after which a level that has reached few cells leaves


@dataclass(frozen=True)
class SearchConfig:
    """Settings of a search (hashable: pass as a static argument)."""

    env_steps: int = 1_048_576  # of one level, all lanes together; rounded up to whole rounds; 0: none
    bodies: int = 7  # of a world that is searched so long; of more, fewer env steps, as the square of their number
    variations: int = 262_144  # env steps in which what came nearest to the goal is varied, after that; 0: none
    patience: int = 393_216  # env steps, of variations a quarter, until a level leaves that comes no nearer; 0: no end
    first_rung: int = 16_384  # env steps at the first rung; each is four times the one before
    per_cell: int = 512  # env steps for each cell reached, above which a level leaves at a rung; 0: none leaves
    # play
    lanes: int = 64  # of one level
    redrawn: tuple[float, ...] = (0.02, 0.05, 0.1, 0.3)  # chance of drawing an entry of the action anew, per env step
    segment: int = 8  # env steps between visits to the archive
    stretch: int = 4  # segments that a lane plays before it returns to a state of the archive
    anew: float = 0.5  # share of returns after which all of the action is drawn anew; else it stays at first
    # archive
    entries: int = 512  # states of one level
    nearer: float = 0.5  # share of returns that go to the nearer to the goal of two states
    # cells: bodies tell states apart by metres, weighted
    width: float = 0.05  # m, of a cell, until the archive is full
    growth: float = 1.15  # by which cells become wider each time it is
    driven_weight: float = 0.5  # of bodies that actuators move, neither green nor blue; of all others it is 1
    # a success
    trials: int = 4  # rounds of attempts to make it shorter, one a lane; the first also verifies it
    # a witness
    polish: int = 0  # env steps of search around it for a shorter one, rounded up to whole rounds; 0: none
    steady: int = 8  # rounds of search around one that few replays survive, for one that more do; 0: none
    # machine
    rounds: int = 2  # between looks of the host

    def __post_init__(self) -> None:
        require(self, ("bodies", "per_cell", "patience"), 0, MAX_COUNTED)
        require(
            self, ("env_steps", "variations", "polish"), 0, MAX_COUNTED // 2
        )  # and what the last round has too many
        require(self, ("steady",), 0, MAX_ROUNDS)
        require(self, ("trials",), 1, MAX_ROUNDS)
        require(self, ("lanes", "segment", "stretch", "rounds", "first_rung"), 1)
        require(self, ("entries",), 1, MAX_ENTRIES)
        require(self, ("nearer", "anew"), 0, 1)
        require(self, ("width",), 0, above=True)
        require(self, ("growth",), 1, above=True)
        require(self, ("driven_weight",), 0)
        if not self.redrawn or not all(0 < chance <= 1 for chance in self.redrawn):
            raise ValueError(f"redrawn is {self.redrawn}: give chances above 0 and at most 1")
        if self.lanes % len(self.redrawn):
            raise ValueError(f"lanes is {self.lanes}: give a multiple of {len(self.redrawn)}, the chances in redrawn")
        if self.steps_per_round > MAX_COUNTED // 4:
            raise ValueError(f"lanes is {self.lanes}: a round, with stretch and segment, is too long; give less")

    def scaled(self, bodies: int) -> "SearchConfig":
        """For worlds of so many bodies: about the time that a small one takes, where env steps cost as their square."""
        share = min(1.0, (self.bodies / bodies) ** 2) if self.bodies else 1.0
        less = {name: int(getattr(self, name) * share) for name in ("env_steps", "variations", "patience")}
        return replace(self, **less)

    @property
    def steps_per_round(self) -> int:
        """Env steps of one level between two choices of where to go on."""
        return self.lanes * self.stretch * self.segment

    @property
    def ends(self) -> StopLimits:
        """When it ends. There is no rung that matters after `env_steps`, which end it anyway."""
        first = -(-self.first_rung // self.steps_per_round) * self.steps_per_round
        rungs = np.array([min(first * 4**i, MAX_COUNTED) for i in range(MAX_RUNGS)], np.int32)
        return StopLimits(*map(np.int32, (self.env_steps, self.variations, self.patience, self.per_cell)), rungs)  # pyright: ignore

    @property
    def endless(self) -> "SearchConfig":
        """The same for all that differ only in when they end, and in what comes after a search."""
        return replace(
            self, env_steps=0, bodies=0, variations=0, patience=0, first_rung=1, per_cell=0, polish=0, steady=0
        )
