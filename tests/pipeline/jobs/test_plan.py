"""`levelproof plan`, on a job so small that the sample is the whole job."""

import json
from pathlib import Path

import pytest

from tests.pipeline.command import TINY, assert_refused, here


@pytest.mark.campaign
def test_plan_prints_a_forecast_and_leaves_no_file(tmp_path: Path) -> None:
    done = here(["plan", *TINY, "executor=inline", "workers=3", "--json"], tmp_path)
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert (facts["levels"], facts["workers"], facts["sample"]["levels"]) == (4, 3, 4)
    assert 0 < facts["wall"]["low"] <= facts["wall"]["expected"] <= facts["wall"]["high"]
    assert facts["solved"]["expected"] == 3.0
    assert (
        facts["bytes"]["witness"]["expected"]
        < facts["bytes"]["resume"]["expected"]
        < facts["bytes"]["full"]["expected"]
    )
    assert not list(tmp_path.iterdir())


def test_plan_rejects_level_files(tmp_path: Path) -> None:
    done = here(["plan", "level_files=mine"], tmp_path)
    assert_refused(done, 2, "plan is for random levels")
