"""`procedure=published` reproduces experts from before there was a search, as its committed results were made."""

from functools import cache

import numpy as np
import pytest

from benchmarks.alone import label
from benchmarks.solved.results import Results, read
from benchmarks.solved.variants import VARIANTS
from levelproof.configs.convert import plain
from levelproof.experts.config import Rule
from levelproof.experts.labels import BY_EXPERT, Label
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels

MASTERED, NEVER = 6, 3  # levels


@cache
def committed() -> dict[str, Results]:
    return {each.header.name: each for each in read()}


def test_published_keeps_its_old_settings_and_disables_new_ones() -> None:
    """Except the first rung, whose default changed: the procedure has no rungs."""
    old, new = committed()["s-64k-published"].header.config, plain(VARIANTS["published"].procedure)
    common = {name: {key: new[name][key] for key in settings} for name, settings in old.items()}
    assert common | {"stop": common["stop"] | {"first_rung": 16_384}} == old
    assert new["stop"]["rule"] == Rule.BUDGET
    assert new["expert"].keys() - old["expert"].keys() == {"imitation_weight", "replays"}
    off = new["expert"]["imitation_weight"], new["expert"]["replays"]
    assert (*off, new["search"]["env_steps"], new["search"]["polish"]) == (0, 0, 0, 0)


@pytest.mark.campaign
def test_published_reproduces_committed_results() -> None:
    """Compare only levels that were mastered then, or never solved since: rounding cannot change their labels."""
    old, since = committed()["s-64k-published"].trained, committed()["s-256k-default"].solved()
    mastered = [i for i, row in old.items() if row["success_rate"] == 1 and row["steps_to_goal"] <= 40][:MASTERED]
    never = [i for i in old if i not in since][:NEVER]
    ids = np.array([*mastered, *never])
    result = label(sample_levels(ids, SIZES["s"]), ids, 64_000, VARIANTS["published"].procedure)
    assert [verdict.label for verdict in result.verdicts] == [Label.SOLVED] * MASTERED + [Label.UNSOLVED] * NEVER
    for level_id, verdict in zip(ids.tolist(), result.verdicts, strict=True):
        assert verdict.env_steps == old[level_id]["env_steps"]
        assert verdict.portability is verdict.cells is None
    for verdict in result.verdicts[:MASTERED]:
        assert verdict.success_rate > 0.5
        assert verdict.witness in BY_EXPERT
    assert result.spent.searched == 0
