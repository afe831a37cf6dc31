"""Saved experts in training: restored bit for bit, and removed only if damaged or finished."""

import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.labels import Source
from levelproof.experts.pool.found import nothing_found
from levelproof.experts.pool.paused import Paused
from levelproof.experts.training.slots import Pending
from levelproof.experts.verdict.judge import Evaluation, KeptExpert
from levelproof.pipeline.errors import StoreFailure
from levelproof.pipeline.store import paused as store
from levelproof.pipeline.store.checkpoints import begun_like
from levelproof.pipeline.store.layout import checkpoint_path, unit_name
from levelproof.pipeline.store.leases import LeaseLost, serve, served
from levelproof.pipeline.store.locks import only_writer
from levelproof.pipeline.store.paused import CheckpointUnread, drop_paused, load_paused, prune_paused, save_paused
from tests.pipeline.made import made_job
from tests.pipeline.servers import Server, serving_bucket
from tests.quick import FAST_COMPILING

JOB = made_job("data", "budget=5k")
UNIT = unit_name(3, 7)
HOLE = 2**40  # bytes


@pytest.fixture(scope="module")
def kept() -> dict[int, Paused]:
    """Experts of two levels; the second has solved its level twice."""
    rng = np.random.default_rng(0)
    like = begun_like(JOB)
    action = np.zeros((RECORD_STEPS, like.training.recent.shape[1], JOB.expert.attempts), np.int32)
    flags = np.zeros((RECORD_STEPS, JOB.expert.environments), bool)
    shown = Evaluation(action, flags, flags, like.training.progress, like.training.success, like.training.course.over)
    filled = lambda tree: jax.tree.map(lambda x: rng.integers(0, 2, x.shape).astype(x.dtype), tree)

    def one(updates: int, evaluations: int) -> Paused:
        begun = filled(like)
        course = begun.training.course._replace(updates=np.asarray(updates, np.int32))
        begun = begun._replace(training=begun.training._replace(course=course))
        findings = nothing_found(1)._replace(source=[Source.SEARCH], search_steps=np.array([5]))
        pending = Pending(np.bool_(True), np.bool_(False), np.int32(9))
        return Paused(
            KeptExpert(begun, [0.5] * updates), pending, 3, [filled(shown) for _ in range(evaluations)], findings
        )

    return {3: one(2, 0), 7: one(5, 2)}


@pytest.fixture
def split(tmp_path: Path, kept: dict[int, Paused]) -> Path:
    save_paused(tmp_path, UNIT, kept, JOB)
    return tmp_path


def same(one: dict[int, Paused], two: dict[int, Paused]) -> None:
    assert one.keys() == two.keys()
    for a, b in zip(one.values(), two.values(), strict=True):
        jax.tree.map(np.testing.assert_array_equal, a, b)


def test_load_paused_restores_every_bit(split: Path, kept: dict[int, Paused]) -> None:
    same(load_paused(split, range(8), JOB), kept)
    same(load_paused(split, [7, 9], JOB), {7: kept[7]})
    assert load_paused(split, [5, 8], JOB) == {}
    drop_paused(split, range(3, 8))
    assert load_paused(split, range(8), JOB) == {}
    drop_paused(split, range(3, 8))


def test_drop_keeps_experts_of_levels_that_were_cut_from_the_unit(split: Path, kept: dict[int, Paused]) -> None:
    drop_paused(split, [3, 4, 5, 6])
    same(load_paused(split, range(8), JOB), kept)


def test_drop_removes_checkpoints_of_other_units_that_had_the_levels(split: Path, kept: dict[int, Paused]) -> None:
    """Levels that a stopped worker returns become another unit."""
    save_paused(split, unit_name(0, 9), {7: kept[7]}, JOB)
    drop_paused(split, [2, 3, 7, 8])
    assert load_paused(split, range(10), JOB) == {}


def test_load_paused_prefers_the_later_checkpoint(split: Path, kept: dict[int, Paused]) -> None:
    save_paused(split, unit_name(0, 7), {3: kept[7], 7: kept[3]}, JOB)  # listed before UNIT
    same(load_paused(split, range(8), JOB), {3: kept[7], 7: kept[7]})


@pytest.mark.parametrize(
    ("name", "other"),
    [("versions", {"jax": "another"}), ("learned_with", {"optax": "another"}), ("device", "cpu: of another kind")],
)
def test_load_paused_ignores_other_settings_and_machines(
    split: Path, name: str, other: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert load_paused(split, range(8), replace(JOB, budget="8k")) == {}
    monkeypatch.setattr(store, name, lambda: other)
    assert load_paused(split, range(8), JOB) == {}


def test_load_paused_ignores_experts_of_another_optimiser(split: Path) -> None:
    before = jax.config.values[FAST_COMPILING]
    jax.config.update(FAST_COMPILING, not before)
    try:
        assert load_paused(split, range(8), JOB) == {}
    finally:
        jax.config.update(FAST_COMPILING, before)


def test_load_paused_ignores_damaged_checkpoints(split: Path) -> None:
    path = checkpoint_path(split, UNIT)
    whole = path.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], whole.replace(b"level_id", b"level_di"), b"x" * 100):
        path.write_bytes(damaged)
        assert load_paused(split, range(8), JOB) == {}


def test_prune_removes_checkpoints_of_committed_levels(split: Path) -> None:
    path = checkpoint_path(split, UNIT)
    (split / "checkpoints" / f".{path.name}.17").touch()
    messages: list[str] = []
    prune_paused(split, np.array([7]), messages.append)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    prune_paused(split, np.array([3, 7, 8]), messages.append)
    assert not list(path.parent.iterdir())
    assert not messages


def pruned(split: Path, *done: int) -> list[str]:
    """Return what `prune_paused` reports about the only checkpoint."""
    messages: list[str] = []
    prune_paused(split, np.array(done), messages.append)
    return messages


def test_save_replaces_no_checkpoint_for_an_earlier_writer(split: Path, kept: dict[int, Paused]) -> None:
    with only_writer(split, print):
        now = served(split)
        serve(split, "an earlier writer")
        with pytest.raises(LeaseLost):
            save_paused(split, UNIT, {3: kept[3]}, JOB)
        same(load_paused(split, range(8), JOB), kept)
        serve(split, now)
        save_paused(split, UNIT, {3: kept[3]}, JOB)
        assert load_paused(split, range(8), JOB).keys() == {3}
        shutil.rmtree(split)
        with pytest.raises(LeaseLost):
            save_paused(split, UNIT, {3: kept[3]}, JOB)
        assert not split.exists()


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="the system has no such users")
@pytest.mark.parametrize("umask", [0o002, 0o000, 0o077])
def test_save_keeps_other_users_out_under_any_umask(tmp_path: Path, kept: dict[int, Paused], umask: int) -> None:
    before = os.umask(umask)
    try:
        save_paused(tmp_path, UNIT, kept, JOB)
    finally:
        os.umask(before)
    assert checkpoint_path(tmp_path, UNIT).stat().st_mode & 0o777 == 0o600
    assert pruned(tmp_path, 7) == []
    same(load_paused(tmp_path, range(8), JOB), kept)


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="the system has no such users")
def test_prune_keeps_a_checkpoint_that_others_can_write_to(split: Path, kept: dict[int, Paused]) -> None:
    path = checkpoint_path(split, UNIT)
    path.chmod(0o664)
    (message,) = pruned(split, 7)
    assert f"{path} cannot be read (Other users can write to {path}" in message
    with pytest.raises(CheckpointUnread, match="make it readable, or remove it to train its experts from the start"):
        load_paused(split, range(8), JOB)
    path.chmod(0o600)
    same(load_paused(split, range(8), JOB), kept)
    path.chmod(0o664)
    assert pruned(split, *range(3, 8)) == []
    assert not path.exists(), "its levels are committed"


def test_prune_removes_and_reports_a_damaged_checkpoint(split: Path) -> None:
    path = checkpoint_path(split, UNIT)
    whole = path.read_bytes()
    for damaged in (
        b"",
        whole[: len(whole) // 2],
        whole[1:],
        whole + b"x",
        whole.replace(b'"levels": [3', b'"levels": [9'),
        whole.replace(b'"bytes": ', b'"bytes": 1e999, "was": '),
    ):
        path.write_bytes(damaged)
        (message,) = pruned(split, 7)
        assert f"{path} is damaged (" in message
        assert not path.exists()


def test_prune_reads_heads_alone(split: Path) -> None:
    path = checkpoint_path(split, UNIT)
    whole = path.read_bytes()
    head = whole.index(b"\n") + 1
    path.write_bytes(whole[:head])
    os.truncate(path, len(whole))  # a hole in place of the archive
    assert pruned(split, 7) == []
    assert path.exists()
    assert load_paused(split, range(8), JOB) == {}, "its bytes have changed"
    size = json.loads(whole[len(store.MAGIC) + 2 : head])["bytes"]
    path.write_bytes(whole[:head].replace(b'"bytes": %d' % size, b'"bytes": %d' % HOLE))
    os.truncate(path, path.stat().st_size + HOLE)
    assert pruned(split, 7) == [], "no machine has memory for all of it"
    assert path.exists()


def test_prune_keeps_a_checkpoint_of_another_version(split: Path) -> None:
    path = checkpoint_path(split, UNIT)
    path.write_bytes(path.read_bytes().replace(b"checkpoint 1 ", b"checkpoint 2 ", 1))
    (newer,) = pruned(split, 7)
    assert f"{path} cannot be read (it has version 2, but this levelproof reads 1)" in newer
    with pytest.raises(CheckpointUnread, match="version 2"):
        load_paused(split, range(8), JOB)
    assert pruned(split, *range(3, 8)) == []
    assert not list(path.parent.iterdir())


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """Start a store with an empty bucket, whose responses this process awaits for a second."""
    with serving_bucket(monkeypatch, tmp_path, 1) as server:
        yield server


def test_checkpoints_in_a_store_survive_time_outs(
    server: Server, kept: dict[int, Paused], monkeypatch: pytest.MonkeyPatch
) -> None:
    split = Path("s3://bucket/data/5k/s")
    save_paused(split, UNIT, kept, JOB)
    same(load_paused(split, range(8), JOB), kept)
    monkeypatch.setattr(store, "MAX_HEAD", 2**12)
    server.log.clear()
    assert pruned(split, 7) == []
    assert [line.rpartition(" ")[2] for line in server.log if ".paused" in line] == ["bytes=0-4095"]

    def silent_of_the_file(_: int) -> None:
        server.spoil(1 if ".paused" in server.log[-1] else 0)

    server.meanwhile = silent_of_the_file
    (message,) = pruned(split, 7)
    assert "cannot be read (Cannot read s3://bucket/data/5k/s/checkpoints/" in message
    with pytest.raises(StoreFailure):
        load_paused(split, range(8), JOB)
    server.meanwhile = lambda _: server.spoil(0)
    same(load_paused(split, range(8), JOB), kept)
    assert pruned(split, 3, 7) == []
    assert load_paused(split, range(8), JOB) == {}
