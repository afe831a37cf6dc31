"""Sealing beside a job: what is done is merged while units come, in what order ever, and trouble never ends the job."""

import random
from pathlib import Path

import pytest

from experts.labels import Label
from pipeline.jobs.schedule import WorkUnit
from pipeline.jobs.seal import Sealer, sealing
from pipeline.jobs.unit import commit
from pipeline.store import seal as store
from pipeline.store.manifest import read_manifest
from tests.pipeline.made import made_job, made_result, made_split

UNITS = [WorkUnit((level_id,)) for level_id in range(12)]


@pytest.fixture
def split(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """With levels 0 and 1."""
    monkeypatch.setattr(store, "ROWS", 3)
    return made_split(tmp_path / "data", [[Label.SOLVED], [Label.UNSOLVED]])


def made(split: Path, sealer: Sealer, unit: WorkUnit) -> None:
    label = Label.SOLVED if unit.level_ids[0] % 2 else Label.UNSOLVED
    commit(made_job(str(split.parents[1])), split, unit, made_result(list(unit.level_ids), [label]))
    sealer.ended(unit, committed=True)
    sealer.look()


def test_units_are_sealed_while_others_come(split: Path) -> None:
    said: list[str] = []
    coming = UNITS[2:]
    random.Random(0).shuffle(coming)
    with sealing(split, read_manifest(split, []).fragments, UNITS[2:], said.append) as sealer:
        for unit in coming:
            made(split, sealer, unit)
            there = {0, 1} | {of.level_ids[0] for of in coming[: coming.index(unit) + 1]}
            assert set(read_manifest(split, []).level_ids.tolist()) == there
    fragments = read_manifest(split).fragments
    assert [(fragment.rows, fragment.sealed) for fragment in fragments] == [(3, True)] * 4
    assert not said


def test_a_unit_that_failed_is_not_waited_for_and_one_that_comes_is(split: Path) -> None:
    with sealing(split, read_manifest(split, []).fragments, UNITS[2:8], print) as sealer:
        for unit in UNITS[3:6]:
            made(split, sealer, unit)
        sealer.finish()
        assert not any(fragment.sealed for fragment in read_manifest(split).fragments), "level 2 may come"
        sealer.ended(UNITS[2], committed=False)
        sealer.finish()
        assert [fragment.rows for fragment in read_manifest(split).fragments] == [3, 1, 1]
        made(split, sealer, UNITS[2])
    assert read_manifest(split).level_ids.tolist() == [0, 1, 2, 3, 4, 5]


def test_trouble_is_told_once_and_never_ends_the_job(split: Path) -> None:
    said: list[str] = []
    shard = next((split / "shards").iterdir())
    (shard / "act/c/0/0/0").write_bytes(b"x")
    with sealing(split, read_manifest(split, []).fragments, UNITS[2:], said.append) as sealer:
        for unit in UNITS[2:]:
            made(split, sealer, unit)
    (sentence,) = said
    assert sentence.startswith(f"Not sealed (The shard {shard} is missing or damaged")
    assert sentence.endswith(f"`levelproof seal {split}` seals it when this has ended.")
    assert len(read_manifest(split).level_ids) == len(UNITS)


def test_a_job_that_fails_leaves_no_half_sealed_fragment(split: Path) -> None:
    def interrupted() -> None:
        with sealing(split, read_manifest(split, []).fragments, UNITS[2:], print) as sealer:
            for unit in UNITS[2:8]:
                made(split, sealer, unit)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not list((split / "manifest").glob(".*"))
    assert {f"shards/{path.name}" for path in (split / "shards").iterdir()} == read_manifest(split).shards
