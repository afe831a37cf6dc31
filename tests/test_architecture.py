"""The directions of imports, and other promises of docs/design.md about the source."""

import ast
import re
import subprocess
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.pace import patience

ROOT = Path(__file__).parent.parent
ROOMS = ("physics", "levelgen", "experts", "configs", "pipeline")  # imported as levelproof.physics, and so on
PRODUCT = (*ROOMS, "levelproof")
OUTSIDE = ("benchmarks", "tests")  # the product imports neither
BELOW = ("experts", "levelgen", "physics")
EXPERTS = (
    "experts.generalist",
    "experts.pool",
    "experts.verdict",
    "experts.training",
    "experts.search",
    "experts.witness",
    "experts.networks",
)
PIPELINE_BELOW = ("configs", *EXPERTS, *BELOW)
# Each room, a folder with its subfolders or one file, and the other rooms that it may import
MAY_IMPORT = {
    "physics.codegen": (),
    "physics": ("physics.codegen",),
    "levelgen.batching": (),
    "levelgen.frames": ("physics",),
    "levelgen.level": ("physics",),
    "levelgen.identity": ("levelgen.level", "physics"),
    "levelgen.vmapped": ("levelgen.batching",),
    "levelgen.programs": ("physics.codegen",),
    "levelgen.sampling": ("levelgen.identity", "levelgen.level", "levelgen.programs", "levelgen.vmapped", "physics"),
    "levelgen.task": ("levelgen.sampling", "levelgen.level", "levelgen.vmapped", "physics"),
    "levelgen.files": ("levelgen.sampling", "levelgen.task", "levelgen.frames", "levelgen.level", "physics"),
    "levelgen.pictures": ("levelgen.frames", "levelgen.level", "physics"),
    "levelgen": ("levelgen", "physics"),
    # "experts" and "pipeline" alone mean the files beside their rooms
    "experts": ("experts.networks", "experts.search", "levelgen", "physics"),
    "experts.networks": ("experts", "levelgen", "physics"),
    "experts.generalist": ("experts.networks", "experts", "levelgen", "physics"),
    "experts.witness": ("experts", "levelgen", "physics"),
    "experts.training": ("experts.witness", "experts", "levelgen", "physics"),
    "experts.search": ("experts.witness", "experts", "levelgen", "physics"),
    "experts.verdict": ("experts.training", "experts.search", "experts.witness", "experts", "levelgen", "physics"),
    "experts.pool": ("experts.verdict", "experts.training", "experts.search", "experts.witness", *BELOW),
    "configs": ("experts", "experts.generalist", "experts.networks", "experts.search", "levelgen", "physics"),
    "pipeline": ("configs",),
    "pipeline.store": ("pipeline", *PIPELINE_BELOW),
    "pipeline.read": ("pipeline.store", "pipeline", *PIPELINE_BELOW),
    "pipeline.dataset": ("pipeline.read", "pipeline.store", "pipeline", *PIPELINE_BELOW),
    "pipeline.exchange": ("pipeline.read", "pipeline.store", "pipeline", *PIPELINE_BELOW),
    "pipeline.verify": ("pipeline.read", "pipeline.store", "pipeline", *PIPELINE_BELOW),
    "pipeline.look": ("pipeline.read", "pipeline.store", "pipeline", *PIPELINE_BELOW),
    "pipeline.play": ("pipeline.look", "pipeline.read", "pipeline.store", "pipeline", *PIPELINE_BELOW),
    "pipeline.jobs": ("pipeline.verify", "pipeline.read", "pipeline.store", "pipeline", *PIPELINE_BELOW),
    "pipeline.learn": (
        "pipeline.look",
        "pipeline.jobs",
        "pipeline.dataset",
        "pipeline.read",
        "pipeline.store",
        "pipeline",
        *PIPELINE_BELOW,
    ),
    "pipeline.cli": (
        "pipeline.learn",
        "pipeline.jobs",
        "pipeline.look",
        "pipeline.play",
        "pipeline.verify",
        "pipeline.exchange",
        "pipeline.store",
        "pipeline",
        "configs",
    ),
    "levelproof": (),  # re-exports from every room
}
RAY_IN = {"pipeline/jobs/cluster.py"}
HYDRA_IN = {"configs/compose.py"}
MAX_LINES = 400  # of a file
FOLDERS = {*PRODUCT, *OUTSIDE, "manifests", "docs", ".ci", ".github"}


def python_files(*folders: str) -> list[Path]:
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


SOURCES = python_files(*PRODUCT)


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@cache
def imported(path: Path) -> tuple[str, ...]:
    """Return every module that a file imports anywhere; each name imported from a package counts as a module."""
    modules = list[str]()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            modules += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name_of(path)} imports relatively"
            modules += [f"{node.module}.{alias.name}" for alias in node.names]
    return tuple(modules)


def libraries(path: Path) -> set[str]:
    return {module.partition(".")[0] for module in imported(path)}


def room(module: str) -> str | None:
    """Return the smallest room that contains a module, without the package's name; None for other people's modules."""
    if module.startswith(tuple(f"levelproof.{name}" for name in ROOMS)):
        module = module.removeprefix("levelproof.")
    return max((name for name in MAY_IMPORT if f"{module}.".startswith(f"{name}.")), key=len, default=None)


def allowed(inner: str, outer: str) -> bool:
    if inner == outer:
        return True
    # "experts" and "pipeline" alone mean the files beside their rooms; any other name means all that is in it
    return any(
        outer == name or (name not in ("experts", "pipeline") and outer.startswith(f"{name}."))
        for name in MAY_IMPORT[inner]
    )


def test_rooms_and_sources_exist() -> None:
    assert {path.parts[len(ROOT.parts)] for path in SOURCES} == set(PRODUCT)
    assert all((ROOT / name.replace(".", "/")).with_suffix(".py").is_file() or (ROOT / name.replace(".", "/")).is_dir()
               for name in MAY_IMPORT)  # fmt: skip


def wrong_imports(path: Path) -> list[str]:
    """Return what a file may not import."""
    wrong = sorted(libraries(path) & {*ROOMS, *OUTSIDE})
    inner = room(".".join(["levelproof", *path.relative_to(ROOT).with_suffix("").parts]))
    assert inner
    if inner == "levelproof":  # re-exports from every room
        return wrong
    return wrong + sorted({outer for outer in map(room, imported(path)) if outer and not allowed(inner, outer)})


def test_imports_run_downwards() -> None:
    wrong = [f"{name_of(path)}: {name}" for path in SOURCES for name in wrong_imports(path)]
    assert not wrong, "\n".join(["these files may not import:", *wrong])


def test_wheel_and_type_checker_cover_the_product_only() -> None:
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
    assert tools["hatch"]["build"]["targets"]["wheel"]["packages"] == ["levelproof"]
    assert "levelproof" in tools["pyright"]["include"]
    for name in ROOMS:
        assert (ROOT / "levelproof" / name).samefile(ROOT / name)


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="needs a git clone")
def test_repository_has_no_unknown_folder() -> None:
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True, timeout=patience(1800)
    ).stdout
    assert {path.partition("/")[0] for path in listed.splitlines() if "/" in path} == FOLDERS


def test_benchmarks_import_no_tests() -> None:
    assert [name_of(path) for path in python_files("benchmarks") if "tests" in libraries(path)] == []


@pytest.mark.parametrize(("library", "allowed"), [("ray", RAY_IN), ("hydra", HYDRA_IN), ("omegaconf", HYDRA_IN)])
def test_library_is_imported_only_at_its_edge(library: str, allowed: set[str]) -> None:
    users = {name_of(path) for path in SOURCES if library in libraries(path)}
    assert users
    assert users <= allowed


def test_levelproof_package_has_no_logic() -> None:
    """It contains only names and their modules, their late import, and the command."""
    assert [path.name for path in python_files("levelproof")] == ["__init__.py", "__main__.py"]
    tree = ast.parse((ROOT / "levelproof/__init__.py").read_text())
    names = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    assert names <= {"__getattr__", "__dir__"}
    rest = [node for node in tree.body if not isinstance(node, ast.FunctionDef | ast.Import | ast.ImportFrom)]
    for node in rest:
        if isinstance(node, ast.If):  # imports for type checkers; the error in a checkout without links
            assert all(isinstance(line, ast.ImportFrom | ast.Raise) for line in node.body + node.orelse)
        elif ast.unparse(node) != "__all__ = list(HOME)":  # the docstring, and literal lists of names
            assert isinstance(node, ast.Expr | ast.Assign)
            ast.literal_eval(node.value)


def test_class_names_are_unique() -> None:
    """A class name identifies its file."""
    homes = defaultdict(list)
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                homes[node.name].append(name_of(path))
    twice = {name: files for name, files in homes.items() if len(files) > 1}
    assert not twice


def lacks(path: Path) -> Iterator[str]:
    """Yield what is wrong with a file as a whole."""
    text = path.read_text()
    if len(text.splitlines()) > MAX_LINES:
        yield f"it is longer than {MAX_LINES} lines"
    if unfinished := re.search(r"\b(TODO|FIXME|XXX)\b", text):
        yield f"it is unfinished: {unfinished[0]}"
    if not ast.get_docstring(ast.parse(text)):
        yield "it does not start with a docstring"


def test_files_are_short_finished_and_documented() -> None:
    wrong = [f"{name_of(path)}: {sentence}" for path in SOURCES for sentence in lacks(path)]
    assert not wrong, "\n".join(wrong)
