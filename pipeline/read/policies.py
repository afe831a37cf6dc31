"""Policies from folders that users name."""

from pathlib import Path

from levelproof.experts.networks.saved import Policy, PolicyError, load_policy
from levelproof.levelgen.level import name_of
from levelproof.physics.types import Size
from levelproof.pipeline.errors import UserError


def policy_at(folder: Path) -> Policy:
    """Load a policy. Raise UserError if the folder has none that this version can use."""
    try:
        return load_policy(folder)
    except PolicyError as error:
        raise UserError(str(error)) from None


def require_size(policy: Policy, size: Size, levels: str, advice: str) -> None:
    """Raise UserError, with advice, if the policy cannot play levels of this size; `levels` names them."""
    if policy.size is not None and not policy.can_play(size):
        raise UserError(
            f"The policy plays levels of size {name_of(policy.size)} only, but the levels of {levels} have size "
            f"{name_of(size)}: {advice}."
        )
