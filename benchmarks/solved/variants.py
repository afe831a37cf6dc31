"""What is compared: the reference's PPO, there and here, our defaults, and our defaults with one thing changed."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from benchmarks.reference.hyperparameters import PPO
from experts.config import Choice, ExpertConfig, Network, Rule, StopConfig

# Other defaults of ours do not change the reference. Its evaluation is ours, so that both are judged alike.
REFERENCE = ExpertConfig(**PPO._asdict(), rehearsals=0, persistence=0.0)


@dataclass(frozen=True)
class Variant:
    """Settings under a name."""

    text: str  # what it is, in a line
    expert: ExpertConfig = field(default_factory=ExpertConfig)
    stop: StopConfig = field(default_factory=StopConfig)
    against: tuple[str, ...] = ("ours",)  # variants it is compared with, level by level
    original: bool = False  # trained and evaluated by the reference's side, in its own environment


def expert(text: str, **changed: Any) -> Variant:
    return Variant(text, expert=replace(ExpertConfig(), **changed))


def stop(text: str, **changed: Any) -> Variant:
    return Variant(text, stop=replace(StopConfig(), **changed))


WHOLE = StopConfig(rule=Rule.BUDGET)
VARIANTS: Mapping[str, Variant] = {
    "original": Variant(
        "the reference's PPO in the reference's own environment and physics, the whole budget for every level",
        replace(REFERENCE, sticky_attempts=0, moved_attempts=0),
        WHOLE,
        ("reference",),
        original=True,
    ),
    "reference": Variant("the reference's hyperparameters, the whole budget for every level", REFERENCE, WHOLE, ()),
    "ours": Variant("the defaults", against=("reference", "original")),
    "ours_budget": Variant("the defaults, the whole budget for every level", stop=WHOLE, against=("reference",)),
    "no_rehearsals": expert("no lanes repeat the first success", rehearsals=0),
    "no_persistence": expert("no lanes repeat their last action", persistence=0.0),
    "horizon_64": expert("64 env steps between updates", horizon=64),
    "lr_3e-4": expert("learning rate 3e-4", learning_rate=3e-4),
    "epochs_8": expert("8 epochs", epochs=8),
    "width_32": expert("hidden layers of 32 units", width=32),
    "no_shaping": expert("no reward for coming closer", dense_reward_scale=0.0),
    "no_entropy": expert("no reward for entropy", entropy_weight=0.0),
    "attempts_16": expert("16 attempts in an evaluation, of which one must succeed", attempts=16),
    "successes_4": stop("solved when 4 attempts of an evaluation succeed", successes=4),
    "successes_8": stop("solved when 8 attempts of an evaluation succeed", successes=8),
    "exploration": expert("a success of training is a witness, too", exploration=True),
    "shortest": expert("the shortest success of any attempt is the witness", witness=Choice.SHORTEST),
    "entity": expert("the network on sets of things", network=Network.ENTITY),
    "halving": stop("a level also leaves at a rung where its learning does not move", rule=Rule.HALVING),
}
