"""Status of a split, for any requested ranges of ids."""

import json
from pathlib import Path

import pytest

from levelproof.experts.labels import Label
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.look.status import read_status
from levelproof.pipeline.store.layout import JOB
from tests.pipeline.made import made_split


def test_read_status_counts_committed_of_requested_levels(tmp_path: Path) -> None:
    split = made_split(tmp_path, [[Label.SOLVED, Label.UNSOLVED, Label.TRIVIAL], [Label.SOLVED, Label.SOLVED]])
    (split / JOB).write_text(json.dumps({"command": "levelproof generate", "level_ids": [[1, 3], [9, 9]]}))
    facts = read_status(split)
    assert (facts["wanted"], facts["done"]) == (4, 3)
    assert facts["labels"] == {"solved": 1, "trivial": 1, "unsolved": 1}


def test_status_of_what_has_no_job_says_what_it_is(tmp_path: Path) -> None:
    """Published splits and seed files have none."""
    split = made_split(tmp_path, [[Label.SOLVED]], "budget=64k")
    (split / JOB).unlink(missing_ok=True)
    with pytest.raises(UserError, match=r"has no job.json, which says what was requested: `levelproof inspect /.*/s`"):
        read_status(split)
    with pytest.raises(UserError, match=r"is not a split, but a folder of 1: name one of them, such as .*64k/s"):
        read_status(tmp_path)
    with pytest.raises(UserError, match="There is no split at"):
        read_status(tmp_path / "nowhere")


@pytest.mark.parametrize("level_ids", ["[[0]]", "[[0, 1e99]]", '[["a", "b"]]', "7", "[[0, 99999999999999999999]]"])
def test_read_status_names_a_damaged_note(tmp_path: Path, level_ids: str) -> None:
    (tmp_path / JOB).write_text(f'{{"command": "", "level_ids": {level_ids}}}')
    with pytest.raises(Exception, match=r"job.json is damaged: run `levelproof generate` for this split again\.$"):
        read_status(tmp_path)
