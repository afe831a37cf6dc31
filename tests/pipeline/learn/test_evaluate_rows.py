"""The rows of `levelproof evaluate`, by who plays."""

from pathlib import Path

from levelproof.experts.evaluation import play_most_probable, play_sampled
from levelproof.pipeline.learn import evaluate


def test_rows_of_a_policy_are_named_by_how_it_plays() -> None:
    one = evaluate._contestant(Path("builtin:s"), "policy")
    assert one.policy
    players = play_sampled(one.policy.network), play_most_probable(one.policy.network)
    assert [*one.entrants] == [one.main, "policy, greedy"] == ["policy, sampled", "policy, greedy"]
    assert tuple(entrant.player for entrant in one.entrants.values()) == players
    assert [entrant.chance for entrant in one.entrants.values()] == [True, False]
