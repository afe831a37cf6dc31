"""An expert under way, as it goes on later: in another slot, process or machine, to the same bits."""

from typing import NamedTuple

from levelproof.experts.pool.found import SearchFindings
from levelproof.experts.training.slots import Pending
from levelproof.experts.verdict.judge import Evaluation, KeptExpert


class Paused(NamedTuple):
    """All that decides how its training goes on and what is told of its level; on the host.

    An evaluation that was under way begins again.
    """

    expert: KeptExpert
    pending: Pending
    evaluated_rollouts: int  # of evaluations that have ended
    evaluations: list[Evaluation]  # those that solved the level
    found: SearchFindings  # before it trained: of one level
