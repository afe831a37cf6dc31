"""`procedure=published` is what experts were before anybody looked: its committed results are of that time."""

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


def test_every_setting_of_then_is_what_it_was_and_all_new_ones_are_off() -> None:
    """But for rungs, which have moved: there are none in it."""
    then, now = committed()["s-64k-published"].header.config, plain(VARIANTS["published"].procedure)
    kept = {name: {key: now[name][key] for key in of} for name, of in then.items()}
    assert kept | {"stop": kept["stop"] | {"first_rung": 16_384}} == then
    assert now["stop"]["rule"] == Rule.BUDGET
    assert now["expert"].keys() - then["expert"].keys() == {"imitation_weight", "replays"}
    off = now["expert"]["imitation_weight"], now["expert"]["replays"]
    assert (*off, now["search"]["env_steps"], now["search"]["polish"]) == (0, 0, 0, 0)


@pytest.mark.campaign
def test_levels_come_out_as_they_did() -> None:
    """Some that were mastered then, and some that nothing has solved since: no change of last bits decides these."""
    then, since = committed()["s-64k-published"].trained, committed()["s-256k-default"].solved()
    mastered = [i for i, of in then.items() if of["success_rate"] == 1 and of["steps_to_goal"] <= 40][:MASTERED]
    never = [i for i in then if i not in since][:NEVER]
    ids = np.array([*mastered, *never])
    result = label(sample_levels(ids, SIZES["s"]), ids, 64_000, VARIANTS["published"].procedure)
    assert [verdict.label for verdict in result.verdicts] == [Label.SOLVED] * MASTERED + [Label.UNSOLVED] * NEVER
    for level_id, verdict in zip(ids.tolist(), result.verdicts, strict=True):
        assert verdict.env_steps == then[level_id]["env_steps"]
        assert verdict.portability is verdict.cells is None
    for verdict in result.verdicts[:MASTERED]:
        assert verdict.success_rate > 0.5
        assert verdict.witness in BY_EXPERT
    assert result.spent.searched == 0
