"""A split of an older sampler reads as before.

golden/sampler-1.tar.xz is what `levelproof generate levels=12 budget=16k executor=inline density=witness` made with the
last commit of sampler version 1, ab2c5f8.
"""

import tarfile
from pathlib import Path

import numpy as np
import pytest

from levelproof.levelgen.identity.content import content_hashes
from levelproof.levelgen.identity.signature import signatures
from levelproof.pipeline.read.levels import SamplerDiffers, levels_of
from levelproof.pipeline.store.manifest import read_manifest
from tests.golden.load import HERE
from tests.pipeline.command import assert_refused, here


@pytest.fixture
def older(tmp_path: Path) -> Path:
    with tarfile.open(HERE / "sampler-1.tar.xz") as archive:
        archive.extraction_filter = getattr(tarfile, "data_filter", None)  # missing before Python 3.11.4
        archive.extractall(tmp_path / "16k")
    return tmp_path / "16k" / "s"


def test_older_split_verifies(older: Path, tmp_path: Path) -> None:
    done = here(["verify", str(older)], tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "12 levels regenerated" in done.stdout
    assert "0 problems" in done.stdout


def test_levels_of_an_older_split_come_from_its_shards(older: Path) -> None:
    """Levels without a witness are resampled from their ids, and still match half of their signature."""
    manifest = read_manifest(older)
    rows = manifest.table.sort_by("level_id")
    with pytest.warns(SamplerDiffers, match="sampled by version 1 of the sampler, but this levelproof has version"):
        levels = levels_of(manifest, rows)
    stored = rows["shard"].is_valid().to_numpy()
    same = np.array(content_hashes(levels)) == rows["content_hash"].to_numpy()
    assert 0 < stored.sum() < len(rows)
    assert same[stored].all()
    for ours, theirs in zip(signatures(levels), rows["signature"].to_pylist(), strict=True):
        assert set(ours) & set(theirs)


@pytest.mark.filterwarnings("error")
def test_witnessed_levels_of_an_older_split_read_without_a_warning(older: Path) -> None:
    manifest = read_manifest(older)
    rows = manifest.table
    levels_of(manifest, rows.filter(rows["shard"].is_valid()))


def test_older_split_is_not_regenerated(older: Path, tmp_path: Path) -> None:
    done = here(["regenerate", f"manifest={older}", "budget=32k", f"out={tmp_path / 'new'}"], tmp_path)
    assert_refused(done, 2, "sampler version 1")
    assert not (tmp_path / "new").exists()
