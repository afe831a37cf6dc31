"""Checkpoints of experts, from several units in one process."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from levelproof.configs.schema import JobConfig
from levelproof.experts.labels import Label, Source
from levelproof.experts.training.slots import begin
from levelproof.experts.verdict.judge import KeptExpert
from levelproof.experts.witness.success import no_success
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store import checkpoints, manifest
from levelproof.pipeline.store.checkpoints import SourceUnseen, experts_for, load_experts, save_experts
from levelproof.pipeline.store.fragment import read_fragment
from tests.pipeline.made import made_job, made_split

UNITS = 3
FILE = "experts/000000000000-000000000001-00000000.npz"
SETTINGS = ("expert.width=8", "expert.environments=24", "expert.attempts=8")


def some_experts(job: JobConfig) -> list[KeptExpert]:
    """Make experts with random bits."""
    ids = np.arange(UNITS, dtype=np.int32)
    levels = sample_levels(ids, SIZES["s"], job.distribution)
    rng = np.random.default_rng(0)
    shapes = begin.eval_shape(levels, ids, no_success(len(ids)), job.expert)
    random = lambda x: np.frombuffer(rng.bytes(x.size * x.dtype.itemsize), x.dtype).reshape(x.shape)
    begun = jax.tree.map(lambda x: rng.random(x.shape) < 0.5 if x.dtype == bool else random(x), shapes)
    return [KeptExpert(jax.tree.map(lambda x, i=i: x[i], begun), [0.0]) for i in range(UNITS)]


def test_load_experts_restores_each_units_experts_bit_for_bit(tmp_path: Path) -> None:
    job = made_job("data", *SETTINGS)
    kept = some_experts(job)
    for i in range(UNITS):
        save_experts(tmp_path / f"{i}.npz", {i: kept[i]})
    for i in range(UNITS):
        back = load_experts(tmp_path / f"{i}.npz", job)[i].begun
        pairs = zip(jax.tree.leaves(kept[i].begun), jax.tree.leaves(back), strict=True)
        assert all(np.asarray(before).tobytes() == np.asarray(after).tobytes() for before, after in pairs)


@pytest.mark.parametrize("over", [np.bool_(True), np.int32(1)], ids=["smaller", "larger"])
def test_load_experts_refuses_other_types(tmp_path: Path, over: np.generic) -> None:
    job, kept = made_job("data", *SETTINGS), some_experts(made_job("data", *SETTINGS))[0]
    training = kept.begun.training
    training = training._replace(course=training.course._replace(over=over))
    save_experts(tmp_path / FILE, {0: kept._replace(begun=kept.begun._replace(training=training))})
    with pytest.raises(Failure, match="over has another shape or type"):
        load_experts(tmp_path / FILE, job)


@pytest.mark.parametrize("source", [Source.SEARCH, Source.SAMPLED])
def test_experts_for_skips_experts_that_solved_their_level(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: Source
) -> None:
    """A search may have replaced the expert's witness. An expert that did not solve its level continues."""
    job = made_job("data", *SETTINGS, f"continue_from={tmp_path}")
    experts = {}
    for i, kept in enumerate(some_experts(job)[:2]):
        course = kept.begun.training.course._replace(solved=np.bool_(i == 0))
        experts[i] = kept._replace(begun=kept.begun._replace(training=kept.begun.training._replace(course=course)))
    save_experts(tmp_path / FILE, experts)
    rows = {0: (source, FILE), 1: (Source.SEARCH, FILE)}
    monkeypatch.setattr(checkpoints, "_kept_in", lambda *_: rows)
    assert experts_for(job, [0, 1, 2]).keys() == {1}


def test_experts_for_reads_only_fragments_of_its_levels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    split, read = made_split(tmp_path, [[Label.SOLVED] * 2] * 4), []

    def noted(path: Path, columns: Sequence[str], *how: Any) -> object:
        read.append((path.stem, set(columns)))
        return read_fragment(path, columns, *how)

    monkeypatch.setattr(manifest, "read_fragment", noted)
    assert experts_for(made_job("data", f"continue_from={split}"), [2, 3]) == {}
    assert read == [("000000000002-000000000003", {"level_id", "witness", "experts"})]


def test_experts_for_refuses_a_missing_source(tmp_path: Path) -> None:
    source = tmp_path / "data/5k/s"
    job = made_job("data", "budget=10k", f"continue_from={source}")
    with pytest.raises(SourceUnseen, match=rf"finds no split at {source}, .* a folder that all machines .* share"):
        experts_for(job, [0])
