"""Variants compared: the reference's PPO on both engines, our procedures, and experts alone with one change."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from benchmarks.reference.hyperparameters import PPO
from levelproof.configs.compose import compose_job
from levelproof.experts.config import Choice, ExpertConfig, Network, Rule, StopConfig
from levelproof.experts.procedure import Procedure

PUBLISHED = compose_job(["procedure=published"]).procedure
ALONE = replace(PUBLISHED, stop=StopConfig(rule=Rule.SOLVED))
# Independent of our defaults; evaluated as ours, so that both are judged alike.
REFERENCE = replace(PUBLISHED, expert=replace(PUBLISHED.expert, **PPO._asdict(), rehearsals=0, persistence=0.0))


@dataclass(frozen=True)
class Variant:
    """Settings of one way to solve levels."""

    text: str  # description, one line
    procedure: Procedure
    against: tuple[str, ...] = ("alone",)  # variants it is compared with, level by level
    original: bool = False  # trained and evaluated by the reference's side, in its own environment


def procedure(name: str, text: str, *against: str) -> Variant:
    return Variant(f"procedure={name}: {text}", compose_job([f"procedure={name}"]).procedure, against)


def expert(text: str, **changed: Any) -> Variant:
    return Variant(text, replace(ALONE, expert=replace(ALONE.expert, **changed)))


def stop(text: str, **changed: Any) -> Variant:
    return Variant(text, replace(ALONE, stop=replace(ALONE.stop, **changed)))


def without(text: str, **changed: Any) -> Variant:
    """Make a variant of the default procedure with the given changes."""
    return Variant(text, replace(Procedure(), **changed), ("default",))


VARIANTS: Mapping[str, Variant] = {
    "original": Variant(
        "the reference's PPO in the reference's own environment and physics, the whole budget for every level",
        replace(REFERENCE, expert=replace(REFERENCE.expert, sticky_attempts=0, perturbed_attempts=0)),
        ("reference",),
        original=True,
    ),
    "reference": Variant("the reference's hyperparameters, the whole budget for every level", REFERENCE, ()),
    "published": procedure("published", "no search before, the whole budget for every level", "reference"),
    "default": procedure("default", "a search, experts from a success", "published", "reference", "alone"),
    "label": procedure("label", "a short search, no experts", "default"),
    "masters": procedure("masters", "experts that succeed in 8 of 8 attempts", "default"),
    "thorough": procedure("thorough", "searches have whole patience at every gap", "default"),
    "no_imitation": without("the default, rehearsed actions are not imitated", expert=ExpertConfig(imitation_weight=0)),
    "width_64": without("the default, hidden layers of 64 units", expert=ExpertConfig(width=64)),
    "alone": Variant("as published, but a level leaves once it is solved", ALONE, ("reference", "original")),
    "no_rehearsals": expert("alone, no lanes repeat the first success", rehearsals=0),
    "no_persistence": expert("alone, no lanes repeat their last action", persistence=0.0),
    "horizon_64": expert("alone, 64 env steps between updates", horizon=64),
    "lr_3e-4": expert("alone, learning rate 3e-4", learning_rate=3e-4),
    "epochs_8": expert("alone, 8 epochs", epochs=8),
    "width_32": expert("alone, hidden layers of 32 units", width=32),
    "no_shaping": expert("alone, no reward for coming closer", dense_reward_scale=0.0),
    "no_entropy": expert("alone, no reward for entropy", entropy_weight=0.0),
    "attempts_16": expert("alone, 16 attempts in an evaluation, of which one must succeed", attempts=16),
    "successes_4": stop("alone, solved when 4 attempts of an evaluation succeed", successes=4),
    "successes_8": stop("alone, solved when 8 attempts of an evaluation succeed", successes=8),
    "shortest": expert("alone, the shortest success of any attempt is the witness", witness=Choice.SHORTEST),
    "entity": expert("alone, the network on sets of entities", network=Network.ENTITY),
    "halving": stop("alone, a level also leaves at a rung where its learning stalls", rule=Rule.HALVING,
                    first_rung=16_384),
}  # fmt: skip
