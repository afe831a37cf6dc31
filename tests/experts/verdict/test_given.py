"""Labels of imported actions; tests of the command `import` label whole folders."""

import jax
import numpy as np
import pytest

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.labels import Label, Source, untrained
from levelproof.experts.verdict import given
from levelproof.experts.verdict.before import decide
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import ACTIONS
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES


def test_witness_overrules_a_proof_that_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    levels = jax.device_get(sample_levels(np.arange(64), "s"))
    verdicts, failed = decide(levels, DEFAULT_RULES)
    at = [
        next(i for i, v in enumerate(verdicts) if v and v.label == label) for label in (Label.TRIVIAL, Label.UNSOLVABLE)
    ]
    wrong = [untrained(Label.UNSOLVABLE, "wrongly proved", False), verdicts[at[1]]]
    monkeypatch.setattr(given, "decide", lambda *_: (list(wrong), failed[at]))
    with pytest.warns(UserWarning, match="solve 1 of 2 levels that are proved unsolvable: wrongly proved"):
        record, labelled = given.label_given(
            take(levels, np.array(at)), np.zeros((RECORD_STEPS, ACTIONS, 2), np.int32), DEFAULT_RULES
        )
    assert labelled[0] is not None
    assert (labelled[0].label, labelled[0].witness) == (Label.SOLVED, Source.IMPORT)
    assert record.goal[:, 0].any()
    assert labelled[1] == wrong[1], "whose actions do not reach the goal"
