"""Settings of the search."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from levelproof.experts.config import MAX_COUNTED, RECORD_STEPS
from levelproof.physics.bounds import require

MAX_ROUNDS = 1024  # limit of `trials` and `robustness`
MAX_RUNGS = 16  # each rung is four times the one before, and env steps are counted in 32 bits
NEAREST = 8  # trajectories of a level that are varied; the first ones come from its archive
LEAST_ROUND = 5  # env steps; `search.edit.Draws` has the random streams below
MAX_ENTRIES = 16_384  # sums of their weights (`experts.search.archive`) must fit 32 bits


class StopLimits(NamedTuple):
    """Stopping limits of a SearchConfig, as arrays: new values need no recompilation."""

    env_steps: Int[Array, ""]
    variations: Int[Array, ""]
    patience: Int[Array, ""]
    patience_gap: Float[Array, ""]
    per_cell: Int[Array, ""]
    rungs: Int[Array, " rung"]  # env steps after which a level with few cells leaves


@dataclass(frozen=True)
class SearchConfig:
    """Settings of a search (hashable: pass as a static argument)."""

    env_steps: int = 1_048_576  # per level, over all lanes; rounded up to whole rounds; 0: no search
    bodies: int = 0  # worlds up to this many bodies get all env steps; n bodies get (bodies/n)² of them; 0: no scaling
    variations: int = 262_144  # env steps after the search, on variations of the nearest trajectories; 0: none
    patience: int = 524_288  # env steps without progress before a level leaves (variations: a quarter); 0: no limit
    patience_gap: float = 0.1  # m, green-blue gap beyond which patience falls as 1/gap, to a quarter; 0: never
    first_rung: int = 16_384  # env steps at the first rung; each rung quadruples them
    per_cell: int = 512  # maximum env steps per cell reached for a level to pass a rung; 0: no limit
    # play
    lanes: int = 64  # lanes per level
    resample: tuple[float, ...] = (
        0.02,
        0.05,
        0.1,
        0.3,
    )  # probability of resampling an entry of the action, per env step
    segment: int = 8  # env steps between visits to the archive
    segments: int = 4  # segments that a lane plays before it returns to an archived state
    new_action: float = 0.5  # share of returns that start with a new random action; others repeat the state's last
    # archive
    entries: int = 512  # archived states per level
    nearer: float = 0.5  # share of returns that draw two states and pick the one nearer to the goal
    # cells: states are told apart by weighted distances of bodies, in metres
    width: float = 0.05  # m, width of a cell until the archive is full
    growth: float = 1.15  # factor by which cells widen each time the archive is full
    driven_weight: float = 0.5  # weight of bodies that actuators move, unless green or blue; all others: 1
    # a success
    trials: int = 4  # rounds of attempts to shorten a success, one per lane; the first also verifies it
    # a witness
    polish: int = 0  # env steps of search around a witness for a shorter one, rounded up to whole rounds; 0: none
    robustness: int = 8  # rounds of search around a fragile witness for a more robust one; 0: none
    # machine
    rounds: int = 2  # rounds per device call, between host syncs

    def __post_init__(self) -> None:
        require(self, ("bodies", "per_cell", "patience"), 0, MAX_COUNTED)
        # half of MAX_COUNTED leaves room for the excess of the last round
        require(self, ("env_steps", "variations", "polish"), 0, MAX_COUNTED // 2)
        require(self, ("robustness",), 0, MAX_ROUNDS)
        require(self, ("trials",), 1, MAX_ROUNDS)
        require(self, ("lanes", "segment", "segments", "rounds", "first_rung"), 1)
        require(self, ("entries",), NEAREST, MAX_ENTRIES)
        require(self, ("nearer", "new_action"), 0, 1)
        require(self, ("width",), 0, above=True)
        require(self, ("growth",), 1, above=True)
        require(self, ("driven_weight", "patience_gap"), 0)
        if not self.resample or not all(0 < chance <= 1 for chance in self.resample):
            raise ValueError(f"resample is {self.resample}: give probabilities above 0 and at most 1")
        if self.lanes % len(self.resample):
            raise ValueError(
                f"lanes is {self.lanes}: give a multiple of {len(self.resample)}, the probabilities in resample"
            )
        if self.steps_per_round < LEAST_ROUND:
            raise ValueError(
                f"lanes is {self.lanes}: a round of lanes x segments x segment env steps has fewer than {LEAST_ROUND}: "
                "raise one of them"
            )
        if self.steps_per_round > MAX_COUNTED // 4:
            raise ValueError(
                f"lanes is {self.lanes}: a round of lanes x segments x segment env steps is too long: lower one of them"
            )
        if self.lanes * self.trials * RECORD_STEPS > MAX_COUNTED // 4:
            raise ValueError(
                f"trials is {self.trials}: with {self.lanes} lanes these are too many env steps: lower one of them"
            )

    def scaled(self, bodies: int) -> "SearchConfig":
        """Scale env steps to a world of this many bodies, so that it takes about as long as a small one.

        An env step costs about the square of the number of bodies.
        """
        share = min(1.0, (self.bodies / bodies) ** 2) if self.bodies else 1.0
        at_least_1 = lambda number: number and max(1, int(number * share))  # 0 means none, or no limit
        reduced = {name: at_least_1(getattr(self, name)) for name in ("env_steps", "variations", "patience")}
        return replace(self, **reduced)

    @property
    def steps_per_round(self) -> int:
        """Env steps of one level between two returns to the archive."""
        return self.lanes * self.segments * self.segment

    @property
    def ends(self) -> StopLimits:
        """Stopping limits; rungs beyond `env_steps` have no effect."""
        first = -(-self.first_rung // self.steps_per_round) * self.steps_per_round
        rungs = np.array([min(first * 4**i, MAX_COUNTED) for i in range(MAX_RUNGS)], np.int32)
        env_steps, variations, patience, per_cell = map(
            np.int32, (self.env_steps, self.variations, self.patience, self.per_cell)
        )
        return StopLimits(env_steps, variations, patience, np.float32(self.patience_gap), per_cell, rungs)  # pyright: ignore

    @property
    def endless(self) -> "SearchConfig":
        """This configuration without limits and rework: equal for all configurations that share compiled programs."""
        return replace(
            self,
            env_steps=0,
            bodies=0,
            variations=0,
            patience=0,
            patience_gap=0,
            first_rung=1,
            per_cell=0,
            polish=0,
            robustness=0,
        )
