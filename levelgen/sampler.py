"""Random levels: the reference's distribution, step by step."""

from jaxtyping import Array, Int

from levelgen.distribution import Distribution
from levelgen.level import Level
from physics.types import Size

__all__ = ["Distribution", "sample_levels"]


def sample_levels(
    level_ids: Int[Array, "level"],
    size: Size,
    distribution: Distribution = Distribution(),  # noqa: B008
) -> Level:
    """The levels with these ids, level axis last."""
    raise NotImplementedError
