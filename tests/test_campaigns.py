"""Campaigns within a time limit: their order follows a seed, and the summary names those that were not reached."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.pace import patience

ROOT = Path(__file__).parent.parent
FILES = 8
TEST = """
import pytest

pytestmark = pytest.mark.campaign


def test_first():
    pass


@pytest.mark.parametrize("case", range(3))
def test_second(case):
    pass
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with small campaigns, in which pytest runs with the plugin that orders tests."""
    folder = tmp_path_factory.mktemp("campaigns")
    for number in range(FILES):
        (folder / f"test_{number}.py").write_text(TEST)
    (folder / "pytest.ini").write_text("[pytest]\nmarkers = campaign\n")
    return folder


def run_pytest(folder: Path, *arguments: str) -> str:
    command = [sys.executable, "-m", "pytest", "-p", "xdist", "-p", "tests.order", "-m", "campaign", "-v", *arguments]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}  # others start slowly
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=patience(300))
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def order(output: str) -> list[str]:
    """Return the files in the order in which their tests ran, a file once for each stretch of its tests."""
    files = re.findall(r"^test_(\d)\.py::", output, re.MULTILINE)
    return [file for number, file in enumerate(files) if number == 0 or file != files[number - 1]]


@pytest.mark.slow
def test_shuffle_orders_files_by_seed_and_keeps_their_tests_together(folder: Path) -> None:
    first, again, other = (order(run_pytest(folder, f"--shuffle={seed}")) for seed in ("1f0a", "1f0a", "77c3"))
    assert first == again
    assert first != other
    assert sorted(first) == sorted(other) == sorted(map(str, range(FILES)))


@pytest.mark.slow
def test_summary_names_campaigns_that_were_not_reached(folder: Path) -> None:
    for processes in ((), ("-n2", "--no-loadscope-reorder")):
        output = run_pytest(folder, "--shuffle=1f0a", "--within=-1", *processes)
        assert f"  {4 * FILES}: not reached: no test begins after -1 s\n" in output
        for number in range(FILES):
            assert f"    test_{number}.py: test_first, test_second (3 cases)\n" in output


def test_summary_omits_campaigns_that_were_reached(folder: Path) -> None:
    assert "not reached" not in run_pytest(folder, "--within=1000")
