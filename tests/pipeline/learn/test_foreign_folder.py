"""A policy's folder that comes from others: commands write to no file elsewhere, and wait for no pipe."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import pytest

from levelproof.experts.networks.saved import CONFIG, WEIGHTS, PolicyError, load_policy
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.learn import folder as run_folder
from levelproof.pipeline.learn.clone import COURSE
from levelproof.pipeline.learn.metrics import CURVES, LOG, METRICS, Metrics
from tests.pipeline.planted import MINE, PLANTED, never_hangs, profile

pytestmark = pytest.mark.slow

__all__ = ["never_hangs", "profile"]  # fixtures

NUMBERS = {COURSE.step: 20} | {f"bc/{kind}{name}": 0.5 for kind in ("", "validation_") for name in ("loss", "accuracy")}
KINDS = [kind for kind in PLANTED if kind != "folder"]


@pytest.fixture
def out(tmp_path: Path) -> Path:
    path = tmp_path / "policy"
    path.mkdir()
    return path


@pytest.mark.parametrize("kind", KINDS)
def test_metrics_write_to_no_file_elsewhere(out: Path, profile: Path, kind: str) -> None:
    PLANTED[kind](out / f".{CURVES}", profile)
    PLANTED[kind](out / CURVES, profile)
    Metrics(out, COURSE, "none", {}, 0, print, list).write(NUMBERS)
    assert profile.read_bytes() == MINE
    assert not profile.with_name("new").exists()
    assert (out / CURVES).read_bytes().startswith(b"\x89PNG")


def test_metrics_log_into_no_folder_elsewhere(out: Path, tmp_path: Path) -> None:
    pytest.importorskip("tensorboardX")
    (tmp_path / "elsewhere").mkdir()
    (out / LOG).symlink_to(tmp_path / "elsewhere")
    messages: list[str] = []
    Metrics(out, COURSE, "tensorboard", {}, 0, messages.append, list)
    assert [text for text in messages if "policy/log is a link" in text] == messages
    assert not list((tmp_path / "elsewhere").iterdir())


@pytest.mark.parametrize("kind", ["link", "pipe", "socket"])
def test_clone_refuses_irregular_files(out: Path, profile: Path, kind: str) -> None:
    reads: dict[str, Any] = {
        METRICS: lambda: Metrics(out, COURSE, "none", {}, 0, print, list),
        run_folder.RUN: lambda: run_folder.require_same_run(out, {}),
        run_folder.CHECKPOINT: lambda: run_folder.continued(out, jnp.zeros(3)),
    }
    for name, read in reads.items():
        PLANTED[kind](out / name, profile)
        with pytest.raises(UserError, match=f"{name} must be a regular file"):
            read()


def test_load_policy_waits_for_no_pipe(out: Path, profile: Path) -> None:
    for name in CONFIG, WEIGHTS:
        PLANTED["pipe"](out / name, profile)
        with pytest.raises(PolicyError, match="no policy"):
            load_policy(out)
        (out / name).unlink()
        (out / name).write_text("{}")
