"""The page of policies beside published agents, on a few of the levels that the reference writes."""

import json
import shutil
from pathlib import Path

import pytest

from benchmarks.__main__ import parser
from benchmarks.agents import demonstrated, run
from levelproof import load_policy
from levelproof.experts.networks.saved import CONFIG, policy_folder

pytestmark = pytest.mark.campaign


def test_report_compares_policies_on_published_levels(tmp_path: Path, reference: Path) -> None:
    words = ["agents", "builtin:s", "--sizes", "s", "--levels", "8", "--folder", str(tmp_path)]
    report = run(parser("agents").parse_args(words))
    random, handmade = report.tables
    assert [row[0] for row in random.rows] == ["doing nothing", "random", "sticky random", "**builtin:s**"]
    origin = load_policy("builtin:s").origin
    trained = [origin["start_origin"]["env_steps"], origin["env_steps"]]
    assert random.rows[-1][1] == "; ".join(f"{steps:,}, random s" for steps in trained)
    assert not any("demonstrations, whose" in note for note in report.notes)
    assert [row[0] for row in handmade.rows] == [row[0] for row in random.rows], "published rates are of all levels"
    assert run(parser("agents").parse_args(words)).results == report.results


def test_demonstrations_of_a_policy_that_training_started_from_count(tmp_path: Path) -> None:
    made = shutil.copytree(policy_folder("builtin:s"), tmp_path / "tuned")
    config = json.loads((made / CONFIG).read_text())
    config["origin"]["start_origin"] = {"splits": [{"levels": 7}, {"levels": 5}]}
    (made / CONFIG).write_text(json.dumps(config))
    assert (demonstrated(str(made)), demonstrated("builtin:s")) == (12, 0)
