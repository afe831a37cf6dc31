"""The example of docs/learners: it learns with both loaders."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.pace import patience
from tests.pipeline.made import played_split

SCRIPT = Path(__file__).parent.parent / "docs" / "learners" / "clone_torch.py"


@pytest.mark.campaign
@pytest.mark.parametrize("loader", ["torch", "grain"])
def test_torch_learns_from_a_split(loader: str, tmp_path: Path) -> None:
    pytest.importorskip("torch")
    pytest.importorskip(loader)
    split = played_split(tmp_path / "data")
    done = subprocess.run(
        [sys.executable, SCRIPT, split, loader],
        capture_output=True,
        text=True,
        cwd=SCRIPT.parents[2],
        timeout=patience(1800),
    )
    assert done.returncode == 0, done.stderr
    first, last, _ = map(float, re.findall(r"\d\.\d+", done.stdout))
    assert last < 0.6 * first
