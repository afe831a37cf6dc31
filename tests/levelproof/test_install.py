"""The built wheel: one import name in site-packages, which no file of the user can shadow."""

import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from collections import Counter
from pathlib import Path

import pytest

from tests.pace import patience
from tests.pipeline.command import ROOT, TINY

ROOMS = ("physics", "levelgen", "experts", "configs", "pipeline")
TRAIN = """
import levelproof

data = levelproof.open("data/5k/s")
env, params = levelproof.make(data.levels([0]))
print("read", len(data), "played", env.name)
"""


def build(source: Path, target: str, folder: Path) -> Path:
    """Build the wheel or the source distribution of a checkout with the project's own build backend."""
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", folder],
        cwd=source,
        check=True,
        timeout=patience(1800),
    )
    (path,) = folder.glob("*.whl" if target == "wheel" else "*.tar.gz")
    return path


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(ROOT, "sdist", tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def wheel(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of the unpacked source distribution, as package indexes and `pip install FILE` build it."""
    folder = tmp_path_factory.mktemp("wheel")
    with tarfile.open(sdist) as file:
        file.extraction_filter = getattr(tarfile, "data_filter", None)  # missing before Python 3.11.4
        file.extractall(folder)
    return build(folder / sdist.name.removesuffix(".tar.gz"), "wheel", folder)


def modules(names: list[str]) -> list[str]:
    return sorted(name for name in names if name.endswith(".py") and name.startswith("levelproof/"))


def test_wheel_installs_levelproof_and_nothing_else(wheel: Path, tmp_path: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    top = {name.partition("/")[0] for name in names}
    assert {name for name in top if not name.endswith(".dist-info")} == {"levelproof"}
    tracked = subprocess.run(
        ["git", "ls-files", *ROOMS], cwd=ROOT, capture_output=True, text=True, timeout=patience(1800)
    ).stdout.split()
    if tracked:
        assert {f"levelproof/{name}" for name in tracked} <= set(names)
    assert sorted(zipfile.ZipFile(build(ROOT, "wheel", tmp_path)).namelist()) == sorted(names)


def test_sdist_holds_each_module_once(sdist: Path, wheel: Path) -> None:
    with tarfile.open(sdist) as file:
        names = [name.partition("/")[2] for name in file.getnames()]
    assert modules(names) == modules(zipfile.ZipFile(wheel).namelist())
    assert not [name for name in names if name.partition("/")[0] in ROOMS]
    assert max(Counter(names).values()) == 1


@pytest.mark.parametrize("room", ROOMS)
def test_room_refuses_a_second_import_name(room: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", f"import {room}"], cwd=ROOT, capture_output=True, text=True, timeout=patience(1800)
    )
    assert f"ImportError: import levelproof.{room}, not {room}" in done.stderr


def test_import_on_windows_names_what_runs() -> None:
    words = "import os, pathlib; os.name = 'nt'; import levelproof"
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, timeout=patience(60))
    assert "ImportError: levelproof runs on Linux and macOS: on Windows, use it in WSL." in done.stderr


def test_import_without_links_says_how_to_get_them(tmp_path: Path) -> None:
    package = tmp_path / "levelproof"
    package.mkdir()
    for path in (ROOT / "levelproof").glob("*.py"):
        shutil.copy(path, package)
    for room in ROOMS:  # as git writes a link where core.symlinks is false
        (package / room).write_text(f"../{room}")
    done = subprocess.run(
        [sys.executable, "-m", "levelproof", "--help"], cwd=tmp_path, capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": ""},
        timeout=patience(1800),
    )  # fmt: skip
    assert "git config core.symlinks true" in done.stderr.splitlines()[-1]


@pytest.fixture(scope="module")
def python(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of a fresh environment in which the wheel is installed.

    levelproof's dependencies come from this environment. Its editable install does not: .pth files do not nest.
    """
    environment = tmp_path_factory.mktemp("environment")
    venv.create(environment)
    site = site_packages(environment / "bin" / "python")
    (site / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"])
    with zipfile.ZipFile(wheel) as file:  # equals installing a pure wheel, except for the command's script
        file.extractall(site)
    return environment / "bin" / "python"


def site_packages(python: Path) -> Path:
    (folder,) = python.parents[1].glob("lib/python*/site-packages")
    return folder


@pytest.fixture
def research(tmp_path: Path) -> Path:
    """A folder with a module of every room's name."""
    for name in ("pipeline.py", "physics.py", "experts.py", "levelgen.py", "configs/__init__.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("raise RuntimeError('levelproof imported a file of the user')\n")
    return tmp_path


def run_in(folder: Path, *command: str | Path) -> str:
    """Run a command without this process's import path; return its output."""
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "RAY_ADDRESS")}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=patience(1800))
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_users_files_shadow_no_public_name(python: Path, research: Path) -> None:
    program = "import levelproof; print(*{getattr(levelproof, name).__module__ for name in ('open', 'make', 'replay')})"
    assert all(name.startswith("levelproof.") for name in run_in(research, python, "-c", program).split())
    home = run_in(research, python, "-c", "import levelproof.physics as room; print(room.__file__)")
    assert Path(home.strip()).is_relative_to(site_packages(python))


@pytest.mark.campaign
def test_workers_ignore_the_users_files(python: Path, research: Path) -> None:
    """The main job on Ray workers and the reader run from that folder, also in a script of the user."""
    (research / "train.py").write_text(TRAIN)
    run_in(research, python, "-m", "levelproof", "generate", *TINY, "workers=2")
    assert run_in(research, python, "train.py").startswith("read")
