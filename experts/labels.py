"""Labels, each with its reason and the evidence for it."""

from dataclasses import dataclass
from enum import StrEnum


class Label(StrEnum):
    """What is known of a level after its expert was trained."""

    SOLVED = "solved"  # a witness was replayed and reached the goal
    UNSOLVED = "unsolved"  # at this budget; no statement about larger ones


@dataclass(frozen=True)
class Verdict:
    """A level's label and what the expert's training and evaluation showed."""

    label: Label
    label_reason: str
    success_rate: float  # of the evaluated episodes, over all attempts; NaN: none ended
    steps_to_goal: int | None  # env steps of the witness's first episode
    steps_to_first_success: int | None  # env steps of training
    env_steps: int  # of training
    learning_curve: list[float]  # per update: share of finished episodes that reached the goal; NaN: none finished
    best_return: float  # of training's episodes, shaping included; -inf: none ended
    episodes: int  # of training


def solved_reason(sampled: bool, episodes: int) -> str:
    how = "sampled" if sampled else "most probable"
    return f"the witness, {how} actions, reaches the goal in all {episodes} of its finished episodes"


def unsolved_reason(attempts: int, training_successes: bool) -> str:
    before = "the goal was reached in training" if training_successes else "the goal was never reached in training"
    return f"{before}; none of {attempts} evaluation records reached it in every finished episode"
