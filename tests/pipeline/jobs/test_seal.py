"""Sealing during a job: committed units are merged while others come, in any order; errors never end the job."""

import random
import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from levelproof.experts.labels import Label
from levelproof.pipeline.jobs import inline
from levelproof.pipeline.jobs import seal as jobs
from levelproof.pipeline.jobs.generate import generate
from levelproof.pipeline.jobs.schedule import WorkUnit
from levelproof.pipeline.jobs.seal import Sealer, sealing
from levelproof.pipeline.store import seal as store
from levelproof.pipeline.store.event_files import events_of, runs_in
from levelproof.pipeline.store.layout import attempt_of, begun_path
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.store.seal import Piece
from tests.pipeline import slow_seal
from tests.pipeline.driver import LEVELS, SPLIT, job_of
from tests.pipeline.made import commit_copy, made_split

Make = Callable[[Sealer, WorkUnit, Collection[WorkUnit]], None]
UNITS = [WorkUnit((level_id,)) for level_id in range(12)]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a split with all UNITS committed."""
    return made_split(tmp_path_factory.mktemp("source"), [[Label.UNSOLVED], [Label.SOLVED]] * (len(UNITS) // 2))


@pytest.fixture
def split(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a split with levels 0 and 1."""
    monkeypatch.setattr(store, "ROWS", 3)
    for number in range(2):
        commit_copy(source, number, tmp_path)
    return tmp_path


@pytest.fixture
def make(source: Path, split: Path) -> Make:
    """Return a function that commits a unit as a worker does, and reports it to the sealer as the driver does."""

    def committed(sealer: Sealer, unit: WorkUnit, coming: Collection[WorkUnit]) -> None:
        commit_copy(source, unit.level_ids[0], split)
        sealer.committed(unit.name, len(unit.level_ids))
        sealer.advance(min((later.level_ids[0] for later in coming), default=None))

    return committed


def test_sealer_seals_units_while_others_are_committed(split: Path, make: Make) -> None:
    messages: list[str] = []
    coming = UNITS[2:]
    random.Random(0).shuffle(coming)
    with sealing(split, read_manifest(split, []).fragments, messages.append) as sealer:
        for i, unit in enumerate(coming):
            make(sealer, unit, coming[i + 1 :])
            there = {0, 1} | {committed.level_ids[0] for committed in coming[: i + 1]}
            assert set(read_manifest(split, []).level_ids.tolist()) == there
    fragments = read_manifest(split).fragments
    assert [(fragment.rows, fragment.sealed) for fragment in fragments] == [(3, True)] * 4
    assert not messages


def test_sealer_waits_for_running_units_but_not_for_failed_ones(split: Path, make: Make) -> None:
    with sealing(split, read_manifest(split, []).fragments, print) as sealer:
        for unit in UNITS[3:6]:
            make(sealer, unit, UNITS[2:3])
        sealer.advance(2)
        assert not any(fragment.sealed for fragment in read_manifest(split).fragments), "level 2 may come"
        sealer.advance(None)  # level 2 has failed
        sealer.finish()
        assert [fragment.rows for fragment in read_manifest(split).fragments] == [3, 1, 1]
        make(sealer, UNITS[2], [])
    assert read_manifest(split).level_ids.tolist() == [0, 1, 2, 3, 4, 5]


def test_sealer_counts_the_groups_that_are_left_after_the_job(split: Path, make: Make) -> None:
    left: list[int] = []
    with sealing(split, read_manifest(split, []).fragments, print) as sealer:
        for unit in UNITS[2:]:
            make(sealer, unit, UNITS[:1])  # as if the first unit ran until the end
        sealer.finish(left.append)
    assert list(dict.fromkeys(left)) == [4, 3, 2, 1, 0]


def test_run_ends_after_its_last_seal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    latest: list[str] = []

    def sealed(split: Path, *given: Any) -> Piece:
        latest.append(events_of(runs_in(split)[-1])[-1]["event"])
        return store.seal(split, *given)

    monkeypatch.setattr(store, "ROWS", LEVELS)
    monkeypatch.setattr(jobs, "seal", sealed)
    monkeypatch.setattr(inline, "run", slow_seal.run)
    monkeypatch.setattr(sys, "argv", ["", "", "", "0"])  # of `slow_seal`
    generate(job_of(str(tmp_path)), ["levelproof", "generate"], Console(quiet=True))
    assert latest == ["progress"]
    (*_, ended) = events_of(runs_in(tmp_path / SPLIT)[-1])
    assert (ended["event"], ended["how"]) == ("ended", "done")


def test_sealer_reports_an_error_once_and_never_ends_the_job(
    split: Path, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages: list[str] = []
    shard = next((split / "shards").iterdir())
    (shard / "act/c/0/0/0").write_bytes(b"x")
    with sealing(split, read_manifest(split, []).fragments, messages.append) as sealer:
        for i in range(2, len(UNITS)):
            make(sealer, UNITS[i], UNITS[i + 1 :])
        sealer.finish()
        monkeypatch.delattr(store, "due")  # nothing more is planned
        sealer.advance(None)
    (sentence,) = messages
    assert sentence.startswith(f"Not sealed (The shard {shard} is missing or damaged")
    assert sentence.endswith(f"run `levelproof seal {split}` when this job has ended.")
    assert len(read_manifest(split).level_ids) == len(UNITS)


def test_sealing_leaves_no_half_sealed_fragment_after_a_failed_job(split: Path, make: Make) -> None:
    def interrupted() -> None:
        with sealing(split, read_manifest(split, []).fragments, print) as sealer:
            for i in range(2, 8):
                make(sealer, UNITS[i], UNITS[i + 1 :])
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    named = read_manifest(split).shards
    replaced = [path for path in (split / "shards").iterdir() if f"shards/{path.name}" not in named]
    assert {*(split / "manifest").glob(".*")} == {begun_path(path) for path in replaced}, "the next job removes these"
    for path in replaced:
        first, last = attempt_of(path).split("-")[:2]
        assert first == last, "a unit's shard, which stopping left beside the sealed one, and none that was half made"
