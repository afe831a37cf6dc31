"""How a level gets its label: everything that decides it but the rules of the task and the budget."""

from dataclasses import dataclass, field

from levelproof.experts.config import ExpertConfig, StopConfig
from levelproof.experts.search.config import SearchConfig


@dataclass(frozen=True)
class Procedure:
    """Who looks, who trains and when that ends (hashable)."""

    search: SearchConfig = field(default_factory=SearchConfig)  # the search before an expert trains
    expert: ExpertConfig = field(default_factory=ExpertConfig)  # who solves it
    stop: StopConfig = field(default_factory=StopConfig)  # when a level leaves its slot
