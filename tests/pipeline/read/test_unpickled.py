"""Readers of splits and folders never unpickle data."""

import _pickle
import pickle
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import levelproof
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.jobs.seal import seal_split
from levelproof.pipeline.read.kinetix.folder import open_folder, read_trajectories
from levelproof.pipeline.store.checkpoints import load_experts
from levelproof.pipeline.store.job_note import read_note
from levelproof.pipeline.verify.verify import examine
from tests.pipeline.made import made_job, played_split
from tests.pipeline.read.kinetix.folder import GOLDEN


def fail(*_: object, **__: object) -> None:
    pytest.fail("a reader unpickled data")


class Unpickler:
    """Replacement of `pickle.Unpickler` that fails the test."""

    __init__ = fail


def read_sealed(split: Path) -> None:
    """Reads and verifies a split at every density."""
    for density in (None, "resume", "witness"):
        if density:
            seal_split(split, None, Console(quiet=True), density)
        data = levelproof.open(str(split))
        assert next(data.batches(2, seed=0)).observation is not None
        assert examine(split).levels == 64


@pytest.mark.campaign
def test_readers_never_unpickle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Compiled programs are pickled in the user's own cache. Reading another split first loads all
    # of them, so that what is unpickled afterwards can only come from the data.
    read_sealed(played_split(tmp_path / "first"))
    split = played_split(tmp_path / "second")
    theirs = tmp_path / "experts.npz"
    np.savez(theirs, level_id=np.array([{}], object), curve=np.zeros((1, 1)))
    for module in (pickle, _pickle):
        monkeypatch.setattr(module, "load", fail)
        monkeypatch.setattr(module, "loads", fail)
        monkeypatch.setattr(module, "Unpickler", Unpickler)
    read_sealed(split)
    assert read_note(split).intact
    with pytest.raises(Failure, match="cannot be read"):
        load_experts(theirs, made_job())
    folder = open_folder(GOLDEN / "s")
    assert read_trajectories(folder.arrays[0], 0, 1).wrong == [""]
