"""How a level gets its label: all settings that decide it, except the task's rules and the budget."""

from dataclasses import dataclass, field

from levelproof.experts.config import ExpertConfig, StopConfig
from levelproof.experts.search.config import SearchConfig


@dataclass(frozen=True)
class Procedure:
    """Settings of search, training and stopping (hashable)."""

    search: SearchConfig = field(default_factory=SearchConfig)  # the search before an expert trains
    expert: ExpertConfig = field(default_factory=ExpertConfig)  # the expert
    stop: StopConfig = field(default_factory=StopConfig)  # when a level leaves its slot
