"""Every Python block of the README and the docs runs unchanged, and imports only the package `levelproof` of ours."""

import ast
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import pytest

import levelproof
from levelproof.experts.networks.over_levels import NetworkConfig, initial_policy
from levelproof.pipeline.exchange.level_json import export
from levelproof.pipeline.exchange.parquet import export_parquet
from levelproof.pipeline.look.gallery.gallery import SITE
from levelproof.pipeline.store.manifest import read_manifest
from tests.pace import patience
from tests.pipeline.made import played_split
from tests.quick import jit_once
from tests.test_commands import run_command, smaller

ROOT = Path(__file__).parent.parent
INSIDE = {"physics", "levelgen", "experts", "configs", "pipeline", "benchmarks", "tests"}


def blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


PAGES = [page for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))] if blocks(page)]

NOTEBOOKS = sorted((ROOT / "docs/notebooks").glob("*.ipynb"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder as the README's commands leave it: its split, levels of it as files, and a policy."""
    folder = tmp_path_factory.mktemp("reader")
    (folder / "manifests").symlink_to(ROOT / "manifests")
    split = played_split(folder / "data")
    assert split == folder / "data/128k/s"
    export(split, int(read_manifest(split).level_ids[0]), folder / "level.json")
    export_parquet(split, None, folder / "levels")
    network = NetworkConfig()
    params = jit_once(initial_policy, static_argnums=(1, 2))(jax.random.key(0), network, levelproof.SIZES["s"])
    levelproof.save_policy(folder / "policy", levelproof.Policy(network, params, None, {}))
    return folder


def test_readme_has_python() -> None:
    assert PAGES[0].name == "README.md"


@pytest.mark.parametrize(
    "page",
    [PAGES[0], *(pytest.param(page, marks=pytest.mark.slow) for page in PAGES[1:])],
    ids=lambda page: page.relative_to(ROOT).as_posix(),
)
def test_python_of_a_page_runs_from_top_to_bottom(page: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    exec(compile("\n".join(blocks(page)), str(page), "exec"), {"__name__": "__main__"})


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_python_of_a_page_imports_only_the_levelproof_package(page: Path) -> None:
    nodes = list(ast.walk(ast.parse("\n".join(blocks(page)))))
    modules = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    modules += [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
    assert not {module.partition(".")[0] for module in modules} & INSIDE


@pytest.mark.campaign
@pytest.mark.parametrize("page", NOTEBOOKS, ids=lambda page: page.stem)
def test_notebook_runs_from_top_to_bottom(
    page: Path, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Commands, which begin with an exclamation mark, run as those of the guides do."""
    monkeypatch.chdir(tmp_path)
    for name in ("data", "manifests"):
        (tmp_path / name).symlink_to(folder / name)
    names = {"__name__": "__main__"}
    for cell in json.loads(page.read_text())["cells"]:
        source = "".join(cell["source"])
        if source.startswith("!levelproof"):
            run_command(smaller(source.removeprefix("!")), tmp_path, inline=True)
        elif cell["cell_type"] == "code":
            exec(compile(source, str(page), "exec"), names)


@pytest.mark.slow
def test_docs_build_without_a_broken_link(tmp_path: Path) -> None:
    words = ["-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        [sys.executable, *words], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=patience(1800)
    )
    assert done.returncode == 0, done.stdout + done.stderr
    page = (tmp_path / "api.html").read_text()
    assert all(f'id="levelproof.{name}"' in page for name in levelproof.__all__ if name != "__version__")
    assert (tmp_path / "example/main.js").read_text() == (SITE / "main.js").read_text()  # a link, in docs/
    assert (tmp_path / "favicon.svg").is_file()
    links = {link for html in tmp_path.rglob("*.html") for link in re.findall(r'src="(https?:[^"]+)', html.read_text())}
    assert not links, "the site loads files from other hosts"
