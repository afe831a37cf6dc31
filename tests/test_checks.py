"""The commands that check a change and a release, and the files that call them."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

from tests.pace import patience

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
UGLY, WRONG, GOOD = "x = [1,2]\n", "import os\n", "x = [1, 2]\n"  # for ruff's formatter, for its linter, for both


def run(command: list[str | Path]) -> subprocess.CompletedProcess[str]:
    """Run a script with the tools of this environment."""
    tools = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    environment = os.environ | {"VIRTUAL_ENV": sys.prefix, "PATH": tools, "PYTHON": sys.executable}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=patience(120))


@pytest.mark.parametrize(
    ("source", "failed"),
    [(GOOD, ""), (UGLY, "format"), (WRONG, "lint"), (WRONG + UGLY, "format lint")],
    ids=["good", "ugly", "wrong", "both"],
)
def test_check_runs_every_check_and_names_those_that_fail(tmp_path: Path, source: str, failed: str) -> None:
    (tmp_path / ".ci").mkdir()
    check = Path(shutil.copy(ROOT / ".ci/check", tmp_path / ".ci"))
    (tmp_path / "module.py").write_text(source)
    done = run([check, "format", "lint"])
    assert done.returncode == bool(failed), done.stdout
    assert done.stderr == (f"Failed: {failed}\n" if failed else "")


def test_check_refuses_an_unknown_check() -> None:
    done = run([ROOT / ".ci/check", "spelling"])
    assert (done.returncode, done.stderr) == (2, "Unknown check spelling: use format, lint, types, tests or slow.\n")


def test_wheel_refuses_the_tag_of_another_version() -> None:
    done = run([ROOT / ".ci/wheel", "v9.8.7"])
    assert done.returncode == 1
    assert done.stderr.startswith(f"The tag is v9.8.7, but pyproject.toml has version {PROJECT['version']}: ")


def test_workflows_and_hooks_call_the_scripts() -> None:
    check, release = (
        yaml.safe_load((ROOT / f".github/workflows/{name}.yml").read_text()) for name in ("check", "release")
    )
    assert [step["run"] for step in check["jobs"]["check"]["steps"] if "run" in step] == [".ci/check", ".ci/check slow"]
    assert any(".ci/wheel" in step.get("run", "") for step in release["jobs"]["wheel"]["steps"])
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    assert [hook["entry"] for hook in hooks] == [".ci/check format", ".ci/check lint", ".ci/check types"]


def test_check_workflow_runs_every_supported_python() -> None:
    workflow = yaml.safe_load((ROOT / ".github/workflows/check.yml").read_text())
    supported = [found[1] for entry in PROJECT["classifiers"] if (found := re.search(r":: (3\.\d+)$", entry))]
    assert workflow["jobs"]["check"]["strategy"]["matrix"]["python"] == supported


def test_citation_has_the_version_and_authors_of_the_project() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == PROJECT["version"]
    assert citation["authors"] == PROJECT["authors"]
    assert citation["license"] == PROJECT["license"]


def test_changelog_uses_known_kinds_of_changes() -> None:
    kinds = re.findall(r"^### (.*)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert kinds
    assert set(kinds) <= {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
