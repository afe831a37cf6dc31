"""The arrows of import, and other promises about the source that docs/design.md makes."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
MAY_IMPORT = {  # our packages only
    "physics": set(),
    "levelgen": {"physics"},
    "experts": {"physics", "levelgen"},
    "configs": {"physics", "levelgen", "experts"},
    "pipeline": {"physics", "levelgen", "experts", "configs"},
}
RAY_IN = {"pipeline/jobs/cluster.py"}
HYDRA_IN = {"configs/compose.py", "pipeline/cli/main.py"}
LONGEST = 400  # lines of a file
SOURCES = sorted(path for package in MAY_IMPORT for path in (ROOT / package).rglob("*.py"))


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def imported(path: Path) -> set[str]:
    """Top-level packages that a file imports, wherever in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name_of(path)} imports relatively"
            found.add((node.module or "").split(".")[0])
    return found


def test_there_is_something_to_look_at() -> None:
    assert {path.parts[len(ROOT.parts)] for path in SOURCES} == set(MAY_IMPORT)


@pytest.mark.parametrize("path", SOURCES, ids=name_of)
def test_imports_run_downwards_only(path: Path) -> None:
    package = path.relative_to(ROOT).parts[0]
    assert imported(path) & set(MAY_IMPORT) <= MAY_IMPORT[package] | {package}


@pytest.mark.parametrize(("library", "allowed"), [("ray", RAY_IN), ("hydra", HYDRA_IN), ("omegaconf", HYDRA_IN)])
def test_a_library_stays_at_its_edge(library: str, allowed: set[str]) -> None:
    users = {name_of(path) for path in SOURCES if library in imported(path)}
    assert users
    assert users <= allowed


@pytest.mark.parametrize("path", SOURCES, ids=name_of)
def test_files_are_short_finished_and_say_what_they_are(path: Path) -> None:
    text = path.read_text()
    assert len(text.splitlines()) <= LONGEST
    assert not re.search(r"\b(TODO|FIXME|XXX)\b", text)
    assert ast.get_docstring(ast.parse(text)), "a module opens by saying what it is"
