"""A witness solves its level on every processor: replaying it gives the same record, bit for bit."""

import json
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.witness.witness import replay
from levelproof.levelgen.level import ACTIONS
from levelproof.levelgen.sampling.sampler import sample_levels
from tests.experts.witness.bits import FILE, digests
from tests.processors import OLD, ROOT, run_on

WITNESSES = np.load(FILE)


def test_witnesses_of_the_reference_manifest_give_their_golden_records() -> None:
    """If the records change, increment SAMPLER_VERSION or ENGINE_VERSION."""
    rows = pq.read_table(ROOT / "manifests" / "128k-s.parquet").to_pylist()
    assert WITNESSES["level_id"].tolist() == [row["level_id"] for row in rows if row["label"] == "solved"]
    assert digests(WITNESSES["level_id"], WITNESSES["action"]) == WITNESSES["digest"].tolist()


@pytest.mark.campaign
@pytest.mark.parametrize("processor", OLD)
def test_witnesses_give_the_same_records_on_other_processors(processor: str) -> None:
    assert json.loads(run_on(processor, "tests.experts.witness.bits")) == WITNESSES["digest"].tolist()


@pytest.mark.parametrize("count", [0, 3])
def test_replay_refuses_no_levels_and_actions_of_others(count: int) -> None:
    with pytest.raises(ValueError, match=rf"{count} levels and actions of shape \(256, 6, 0\)"):
        replay(sample_levels(np.arange(4), "s")[:count], np.zeros((RECORD_STEPS, ACTIONS, 0), int))


@pytest.mark.parametrize("shape", [(RECORD_STEPS, 4), (100, ACTIONS, 4), (RECORD_STEPS, 4, ACTIONS)])
def test_replay_refuses_actions_of_another_shape(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"pass at least one level, and actions of shape \(256, 6, levels\)"):
        replay(sample_levels(np.arange(4), "s"), np.zeros(shape, int))


def test_replay_refuses_actions_of_another_type() -> None:
    with pytest.raises(TypeError, match="the actions are float64, but must be integers"):
        replay(sample_levels(np.arange(4), "s"), np.zeros((RECORD_STEPS, ACTIONS, 4)))


def test_replay_takes_arrays_that_all_levels_share() -> None:
    levels, actions = sample_levels(np.arange(4), "s"), np.ones((RECORD_STEPS, ACTIONS, 4), int)
    shared = replace(levels, model=replace(levels.model, gravity=np.array([[0.0], [-1.6]], np.float32)))
    assert (replay(shared, actions).state.position != replay(levels, actions).state.position).any()
