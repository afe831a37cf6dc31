"""A paused expert, which can resume in another slot, process or machine of the same kind, to the same bits."""

from typing import NamedTuple

from levelproof.experts.pool.found import SearchFindings
from levelproof.experts.training.slots import Pending
from levelproof.experts.verdict.judge import Evaluation, KeptExpert


class Paused(NamedTuple):
    """All that decides how training continues and what is reported of the level; on the host.

    An interrupted evaluation is repeated from its start.
    """

    expert: KeptExpert
    pending: Pending
    evaluated_rollouts: int  # of finished evaluations
    evaluations: list[Evaluation]  # evaluations that solved the level
    found: SearchFindings  # findings of its only level
