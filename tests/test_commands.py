"""Every `levelproof` command that the README and the docs show does what it says, on a smaller scale."""

import re
import shlex
import shutil
from pathlib import Path

import pytest

from tests.pipeline.command import here, run

pytestmark = pytest.mark.campaign

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LEVELS = 8  # in place of as many as a page says
BUDGETS = {"64k": "3k", "128k": "4k", "256k": "5k", "1M": "6k"}  # what a page says, and what runs, folders as well
JOBS = ("generate", "regenerate", "plan")
ELSEWHERE = ("levelproof play", "://", "HEAD:", "me/levels")  # servers, and other hosts: tests/pipeline has their tests
WITH_WORKERS = ("README", "cluster")  # pages of which every job starts Ray; others' are done in this process
NOBODY = "No level", "no trajectories", "holds for none"  # of so few fits a condition


def smaller(line: str) -> list[str]:
    """The words of a command, with budgets and levels that take seconds."""
    for said, small in BUDGETS.items():
        line = re.sub(rf"\b{said}\b", small, line)
    words = [re.sub(r"^levels=.*", f"levels={LEVELS}", word) for word in shlex.split(line, comments=True)[1:]]
    words = words[: words.index(">")] if ">" in words else words  # of a shell
    asks = words[0] == "generate" and not any(word.startswith(("levels=", "level_files=", "-")) for word in words)
    return words + asks * [f"levels={LEVELS}"]


def commands(page: Path) -> list[list[str]]:
    lines = re.findall(r"^    (?:pip install \S+ && )?(levelproof .*)", page.read_text(), re.MULTILINE)
    return [smaller(line) for line in lines if not any(word in line for word in ELSEWHERE)]


def typed(words: list[str], folder: Path, inline: bool) -> None:
    """In a process of its own what starts workers, in this one what only reads, and jobs that are to be `inline`."""
    inline &= words[0] in JOBS
    starts = words[0] in JOBS or "--repair" in words
    done = run(words, folder) if starts and not inline else here([*words, *["executor=inline"] * inline], folder)
    nobody = done.returncode == 2 and any(word in done.stderr for word in NOBODY)
    assert done.returncode == 0 or nobody, f"levelproof {shlex.join(words)}: {done.stdout[-500:]}{done.stderr[-1500:]}"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What pages take for granted: splits, level files, and a folder of the reference's."""
    folder = tmp_path_factory.mktemp("docs")
    for size, budget in (("s", "4k"), ("s", "5k"), ("s", "6k"), ("m", "5k"), ("m", "6k")):
        typed(["generate", f"size={size}", f"budget={budget}", f"levels={LEVELS}"], folder, True)
    typed(["export", "data/4k/s", "7", "-o", "level.json"], folder, True)
    for name in ("mine", "handmade"):
        (folder / name).mkdir()
        shutil.copy(folder / "level.json", folder / name)
    everything = ["--where", "shard IS NOT NULL"]
    typed(["export", "data/6k/s", "--format", "kinetix", *everything, "-o", "kinetix/6k/s"], folder, True)
    return folder


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=lambda page: page.stem)
def test_commands_of_a_page_run_in_order(page: Path, made: Path, tmp_path: Path) -> None:
    for words in commands(page):
        for name in re.findall(r"data/\w+/\w+|kinetix/\w+/\w+|level\.json|\bmine\b|\bhandmade\b", " ".join(words)):
            makes = words[0] == "import" and f"-o {name}" in " ".join(words)
            if (made / name).exists() and not (tmp_path / name).exists() and not makes:
                copy = shutil.copytree if (made / name).is_dir() else shutil.copy
                (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
                copy(made / name, tmp_path / name)
        typed(words, tmp_path, page.stem not in WITH_WORKERS)
