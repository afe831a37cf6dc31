"""What the folders of the commands that train a policy hold, and what their guides list."""

import json
import os
import signal
from collections.abc import Mapping
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file

from levelproof.configs.compose import override_of
from levelproof.configs.convert import plain
from levelproof.configs.meanings import comments_in
from levelproof.experts.networks.saved import WEIGHTS
from levelproof.pipeline.learn.pace import Pace
from tests.pipeline.command import ROOT


def metrics(out: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]


def assert_average_is_kept(out: Path, average: str, last: str) -> None:
    """Check that a folder's policy has the average of the weights, not the last ones; by prefixes in the checkpoint."""
    kept, weights = load_file(out / "checkpoint.safetensors"), load_file(out / WEIGHTS)
    for name, values in weights.items():
        np.testing.assert_array_equal(values, kept[average + name])
    assert any((values != kept[last + name]).any() for name, values in weights.items())


def stop_in_first_update(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a learner get SIGTERM, which batch systems send before they kill it, as its first update or round ends."""
    count, sent = Pace.count, list[int]()

    def counting(pace: Pace, done: int) -> float:
        if not sent:
            sent.append(done)
            os.kill(os.getpid(), signal.SIGTERM)
        return count(pace, done)

    monkeypatch.setattr(Pace, "count", counting)


def assert_guide_lists(settings: Mapping[str, Any], *pages: str) -> None:
    """Check that these pages list every setting with its default and meaning; `settings` by prefix."""
    guide = "".join((ROOT / f"docs/{page}.md").read_text() for page in pages)
    for path, group in settings.items():
        for name, comment in comments_in(type(group)).items():
            value = getattr(group, name)
            if not is_dataclass(value):
                assert f"| `{override_of(path + name, plain(value))}` | {comment.beside} |" in guide
