"""`examine` on forged witnesses whose records replay in every bit, and on settings that differ."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from levelproof.configs.schema import hash_of
from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.labels import Label
from levelproof.experts.witness.witness import Record, replay
from levelproof.levelgen.level import ACTIONS, Level
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.fields import arrays_of, tree_of
from levelproof.pipeline.store.formats import CONFIG_KEY, HASH_KEY
from levelproof.pipeline.store.manifest import fragment_paths
from levelproof.pipeline.store.shard import Shard, write_shard
from levelproof.pipeline.verify.verify import examine
from tests.pipeline.made import rewrite
from tests.pipeline.verify.forged import Row, assert_reported, forge, rows_labelled

NOTHING = np.zeros((RECORD_STEPS, ACTIONS), np.int32)


def rerecord(split: Path, row: Row, action: np.ndarray) -> None:
    """Replace a level's record by that of these actions."""
    shard = Shard(split / row["shard"])
    arrays = shard.read()
    actions = tree_of(Record, arrays, "record/").action.copy()
    actions[..., row["row"]] = action
    made = replay(tree_of(Level, arrays, "level/"), actions)
    shutil.rmtree(shard.path)
    write_shard(shard.path, shard.level_ids, arrays | arrays_of(made, "record/"))
    forge(split)


def test_examine_finds_a_witness_that_does_not_reach_the_goal(split: Path) -> None:
    row = rows_labelled(split, Label.SOLVED)[0]
    rerecord(split, row, NOTHING)
    assert_reported(split, f"Level {row['level_id']} has a witness that does not reach the goal when replayed.")


def test_examine_finds_a_trivial_level_whose_witness_acts(split: Path) -> None:
    """At the record's last step, after the goal."""
    row, action = rows_labelled(split, Label.TRIVIAL)[0], NOTHING.copy()
    rerecord(split, row, action)
    assert_reported(split)
    action[-1, 0] = 1
    rerecord(split, row, action)
    assert_reported(split, f"Level {row['level_id']} is trivial, but its witness does something.")


@pytest.mark.parametrize(("label", "other"), [(Label.SOLVED, Label.UNSOLVED), (Label.UNSOLVED, Label.SOLVED)])
def test_examine_finds_a_label_that_denies_its_shard(split: Path, label: Label, other: Label) -> None:
    row = rows_labelled(split, label)[0]
    forge(split, lambda row: row.update(label=other.value), [row["level_id"]])
    assert_reported(split, f"Level {row['level_id']} is {other}, but its shard is {row['shard']}.")


def test_examine_is_refused_if_fragments_have_different_settings(split: Path) -> None:
    """Their levels are made or played differently, so no recipe fits all."""
    path = fragment_paths(split)[-1]
    table = pq.read_table(path)
    config = json.loads((table.schema.metadata or {})[CONFIG_KEY])
    config["task"]["max_timesteps"] -= 1
    rewrite(path, table, {CONFIG_KEY: json.dumps(config), HASH_KEY: hash_of(config)}, write_page_checksum=True)
    with pytest.raises(Failure, match=f"mixes two configurations, the one of {path.name} .*task.max_timesteps was"):
        examine(split)
