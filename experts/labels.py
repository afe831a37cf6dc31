"""Labels of levels, with their reasons and evidence."""

from dataclasses import dataclass, field, replace
from enum import IntEnum, StrEnum
from math import inf, nan

from levelproof.levelgen.proofs import Proof


class Label(StrEnum):
    """Result of labelling a level."""

    SOLVED = "solved"  # a witness was replayed and reached the goal
    UNSOLVED = "unsolved"  # at this budget; no statement about larger ones
    TRIVIAL = "trivial"  # doing nothing solves it and is its witness; no expert was trained
    UNSOLVABLE = "unsolvable"  # proved; no expert was trained


class Source(StrEnum):
    """Origin of a witness."""

    MOST_PROBABLE = "most probable"  # the expert's most probable actions
    SAMPLED = "sampled"  # actions sampled from the expert's policy in its evaluation
    EXPLORATION = "exploration"  # actions of an episode of training
    SEARCH = "search"  # search before training, or around another witness
    NOTHING = "nothing"  # doing nothing, in a trivial level
    IMPORT = "import"  # actions from another program's data


class Cause(IntEnum):
    """Why an expert stopped training for good."""

    NONE = 0  # training has not stopped for good: a larger budget would continue it
    RUNG = 1  # the best return had not grown
    FRUITLESS = 2  # the expert itself had no success after `stop.fruitless` env steps
    DIVERGED = 3  # the expert's parameters were no longer finite


MADE_BY = {
    Source.EXPLORATION: "actions of training",
    Source.SEARCH: "actions of the search",
}
UNTRAINED = "no search reached the goal, and the procedure trains no expert"
DIVERGED = "stopped being finite"  # in the reasons of levels whose experts diverged
WITNESSED = frozenset({Label.SOLVED, Label.TRIVIAL})  # labels that need a witness
TRAINED = frozenset({Label.SOLVED, Label.UNSOLVED})  # labels of levels that need an expert
BY_EXPERT = frozenset({Source.MOST_PROBABLE, Source.SAMPLED})  # sources of witnesses from an expert's policy


@dataclass(frozen=True)
class Verdict:
    """A level's label and what the expert's training and evaluation showed."""

    label: Label
    label_reason: str
    failed_by_noop: bool  # doing nothing lets green touch red
    witness: Source | None = None
    success_rate: float = nan  # of sampled attempts after training, first episodes; NaN: no attempts
    # of the last evaluation; NaN: no such attempts
    most_probable_succeeds: bool = False  # in every episode of the attempt with the most probable actions
    sticky_success_rate: float = nan  # of attempts with sticky actions, first episodes
    perturbed_success_rate: float = nan  # of attempts from perturbed velocities, first episodes
    steps_to_goal: int | None = None  # env steps of the witness's first episode
    steps_to_first_success: int | None = None  # env steps of training
    env_steps: int = 0  # of training
    # per update: share of finished episodes that reached the goal; NaN: none finished
    learning_curve: list[float] = field(default_factory=list)
    best_return: float = -inf  # of training's episodes, shaping included; -inf: none ended
    episodes: int = 0  # of training
    portability: float | None = None  # share of the witness's replays from perturbed starts that reach the goal
    evaluation_steps: int = 0  # env steps
    search_steps: int = 0  # env steps
    cells: int | None = None  # cells that the search reached; None: not searched
    still_grew: bool | None = None  # whether the archive was still growing when the search ended


def solved_reason(source: Source, episodes: int) -> str:
    how = MADE_BY.get(source, f"{source} actions")
    return f"the witness, {how}, reaches the goal in all {episodes} of its finished episodes"


def unsolved_reason(attempts: int, reached: bool, over: Cause, env_steps: int) -> str:
    """Say why a level is unsolved.

    Args:
        attempts: number of attempts in the last evaluation.
        reached: whether the expert itself reached the goal in training.
        over: why its training stopped for good.
        env_steps: env steps of its training.
    """
    before = "the expert reached the goal in training" if reached else "the expert never reached the goal in training"
    why = {
        Cause.NONE: "",
        Cause.RUNG: ", and at a rung the best return had not grown",
        Cause.FRUITLESS: f", so it left after {env_steps} env steps",
        Cause.DIVERGED: f", and its network's numbers {DIVERGED} after {env_steps} env steps",
    }[over]
    return f"{before}{why}; none of the {attempts} attempts of the last evaluation is a witness"


def trivial_reason(steps: int) -> str:
    return f"doing nothing reaches the goal in {steps} env steps"


ARGUMENTS = {
    Proof.NOTHING_ACTS: "no action has an effect",
    Proof.GOAL_STANDS: "no green or blue body that could touch the other colour ever moves",
}


def unsolvable_reason(proof: Proof, fails: bool) -> str:
    how = "lets green touch red" if fails else "does not reach the goal"
    return f"{ARGUMENTS[proof]}, and doing nothing {how}"


def untrained(
    label: Label,
    label_reason: str,
    failed_by_noop: bool,
    witness: Source | None = None,
    steps_to_goal: int | None = None,
    portability: float | None = None,
) -> Verdict:
    """Return the verdict on a level without an expert. If none is needed, doing nothing counts as its evaluation."""
    verdict = Verdict(
        label, label_reason, failed_by_noop, witness, steps_to_goal=steps_to_goal, portability=portability
    )
    if label in TRAINED:
        return verdict
    return replace(verdict, success_rate=float(label in WITNESSED), most_probable_succeeds=label in WITNESSED)
