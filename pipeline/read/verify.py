"""Is a split what it claims to be? Every shard read, every witness replayed, manifest rows against shard rows.

Bits are promised on the stack that made a row; on another one, that the witness reaches the goal.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from configs.convert import typed
from configs.errors import ConfigError
from experts.labels import WITNESSED, Label
from experts.witness import Record, replay, steps_to_goal, succeeds
from levelgen.level import Level
from levelgen.task.rules import TaskParams
from pipeline.errors import Exit, Failure
from pipeline.jobs.unit import unlike_fields
from pipeline.runtime import prepare_jax
from pipeline.store.fields import tree_of
from pipeline.store.manifest import require_manifest
from pipeline.store.provenance import device, versions
from pipeline.store.shard import Shard, open_shard


@dataclass
class Findings:
    """What was looked at, and what is wrong."""

    shards: int = 0
    witnesses: int = 0
    same_bits: int = 0  # of the witnesses: replayed bit for bit
    wrong: list[str] = field(default_factory=list)


def verify(split: Path, as_json: bool) -> Exit:
    """Print what is wrong with `split`; FAILED if anything is.

    Raises:
        UserError: no split.
        Failure: a fragment is damaged.
    """
    findings = examine(split)
    if as_json:
        print(json.dumps(findings.__dict__, indent=2))
    else:
        for sentence in findings.wrong:
            print(sentence)
        print(
            f"{split}: {findings.shards} shards read, {findings.witnesses} witnesses replayed, "
            f"{findings.same_bits} of them bit for bit, {len(findings.wrong)} problems."
        )
    return Exit.FAILED if findings.wrong else Exit.DONE


def examine(split: Path) -> Findings:
    """Look at every row and every shard of a split."""
    manifest, findings = require_manifest(split), Findings()
    prepare_jax()
    try:
        task = typed(TaskParams, (manifest.config or {})["task"], "task")
    except (ConfigError, KeyError) as error:
        raise Failure(
            f"The split {split} was made by a levelproof with other settings ({error}): use that one."
        ) from None
    by_shard: dict[str, list[dict[str, Any]]] = {}
    for row in manifest.table.to_pylist():
        if (row["label"] in WITNESSED) != (row["shard"] is not None):
            findings.wrong.append(f"Level {row['level_id']} is {row['label']}, and its shard is {row['shard']}.")
        if row["shard"] is not None:
            by_shard.setdefault(row["shard"], []).append(row)
    for name, rows in by_shard.items():
        try:
            _examine_shard(open_shard(split, name, rows[0]["size"]), rows, task, findings)
        except Failure as failure:
            findings.wrong.append(str(failure))
    return findings


def _examine_shard(shard: Shard, rows: list[dict[str, Any]], task: TaskParams, findings: Findings) -> None:
    claimed = {row["row"]: row["level_id"] for row in rows}
    if claimed != dict(enumerate(shard.level_ids)):
        raise Failure(f"The shard {shard.path} holds levels {shard.level_ids}, the manifest says {claimed}.")
    arrays = shard.read()
    level, record = tree_of(Level, arrays, "level/"), tree_of(Record, arrays, "record/")
    again = replay(level, record.action, task)
    done, goal = np.asarray(again.done), np.asarray(again.goal)
    differs, reached, steps = unlike_fields(record, again), succeeds(done, goal), steps_to_goal(done)
    findings.shards += 1
    for row in rows:
        i, level_id = row["row"], row["level_id"]
        findings.witnesses += 1
        findings.same_bits += i not in differs
        if i in differs and _same_stack(row):
            findings.wrong.append(f"The witness of level {level_id} does not replay: its {differs[i]} differs.")
        elif not reached[i]:
            findings.wrong.append(f"The witness of level {level_id} does not reach the goal when replayed.")
        elif row["label"] == Label.TRIVIAL and np.any(record.action[..., i]):
            findings.wrong.append(f"Level {level_id} is trivial, and its witness does something.")
        elif i not in differs and row["steps_to_goal"] != steps[i]:
            findings.wrong.append(
                f"Level {level_id} reaches the goal in {steps[i]} steps, the manifest says {row['steps_to_goal']}."
            )


def _same_stack(row: Mapping[str, Any]) -> bool:
    """Whether bits are promised: the row was made with these versions on such a device."""
    return row["versions"] == versions() and row["device"] == device()
