"""Checkpoints of experts, where several units of a worker keep theirs at once."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experts.judge import Kept
from experts.labels import Label
from experts.slots import begin
from levelgen.level import SIZES
from levelgen.sampling.sampler import sample_levels
from pipeline.store import manifest
from pipeline.store.checkpoints import experts_for, load_experts, save_experts
from pipeline.store.manifest import read_fragment
from tests.pipeline.made import made_job, made_split

UNITS = 6


@pytest.mark.slow
def test_units_in_threads_keep_their_experts_at_once(tmp_path: Path) -> None:
    job = made_job("data", "expert.width=8", "expert.environments=24")
    ids = np.arange(UNITS, dtype=np.int32)
    levels = sample_levels(jnp.asarray(ids), SIZES["s"], job.distribution)
    begun = jax.tree.map(np.asarray, begin(levels, ids, job.expert))
    together = Barrier(UNITS)

    def saved_and_loaded(level_id: int) -> Kept:
        kept = Kept(jax.tree.map(lambda x: x[level_id], begun), [0.0])
        together.wait()
        save_experts(tmp_path / str(level_id), {level_id: kept})
        together.wait()
        return load_experts(tmp_path / str(level_id), job)[level_id]

    with ThreadPoolExecutor(UNITS) as threads:
        for level_id, kept in enumerate(threads.map(saved_and_loaded, range(UNITS))):
            pairs = zip(jax.tree.leaves(begun), jax.tree.leaves(kept.begun), strict=True)
            assert all(before[level_id].tobytes() == np.asarray(after).tobytes() for before, after in pairs)


def test_a_worker_reads_the_fragments_of_its_levels_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    split, read = made_split(tmp_path, [[Label.SOLVED] * 2] * 4), []

    def noted(path: Path, columns: Sequence[str]) -> object:
        read.append((path.stem, set(columns)))
        return read_fragment(path, columns)

    monkeypatch.setattr(manifest, "read_fragment", noted)
    assert experts_for(made_job("data", f"continue_from={split}"), [2, 3]) == {}
    assert read == [("000000000002-000000000003", {"level_id", "label", "experts"})]
