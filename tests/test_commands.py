"""Every `levelproof` command in the README and the docs runs, on a smaller scale."""

import re
import shlex
import shutil
from pathlib import Path

import pytest

from tests.pipeline.command import here, run
from tests.quick import make_room

pytestmark = pytest.mark.campaign

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LEVELS = 8  # instead of the numbers on a page
BUDGETS = {"64k": "3k", "128k": "4k", "256k": "5k", "1M": "6k"}  # budgets on a page, and those that run; also folders
JOBS = ("generate", "regenerate", "plan", "grow")
ELSEWHERE = ("levelproof play", "://", "HEAD:", "me/levels")  # servers and other hosts, which tests/pipeline tests
WITH_WORKERS = ("README", "cluster")  # pages whose jobs run on Ray; those of other pages run in this process
NO_MATCH = "No level", "no trajectories", "too few levels"  # a condition fits none of so few levels
LEARNERS = "clone", "train", "distill"  # whose levels are made so that some fit


def smaller(line: str) -> list[str]:
    """Return the arguments of a command, with budgets and levels that take seconds."""
    for budget, small in BUDGETS.items():
        line = re.sub(rf"(?<!manifests/)\b{budget}\b", small, line)
    words = [re.sub(r"^levels=\d.*", f"levels={LEVELS}", word) for word in shlex.split(line, comments=True)[1:]]
    words = words[: words.index(">")] if ">" in words else words  # without a shell's redirection
    committed = "level_id < 60" if any("manifests/" in word for word in words) else ""
    unlimited = words[0] == "generate" and not any(word.startswith(("levels=", "level_files=", "-")) for word in words)
    if words[0] == "clone":
        words = [word for word in words if not word.startswith(("train.", "where="))]
        words += ["train.updates=4", "train.batch=32", "validation=0.5", "played=8", f"where={committed}"]
    if words[0] == "distill":
        words += ["train.updates=4", "interval=2", "train.batch=32", "episodes=4", "states=4", f"where={committed}"]
    if words[0] == "train":
        words = [word for word in words if not word.startswith(("ppo.env", "ppo.critic_updates"))]
        words += ["ppo.environments=32", "ppo.horizon=8", "ppo.minibatches=4", "ppo.env_steps=16384"]  # 16 updates
        words += ["ppo.critic_updates=1"] * any(word.startswith("start=") for word in words)
        words += ["replay.capacity=8"] * any(word in ("levels=replay", "levels=evolve") for word in words)
        words += ["evolve.every=2", "evolve.children=4"] * ("levels=evolve" in words)
        words += ["where="] if any("data/" in word for word in words) else []
    if words[0] == "evaluate":
        words += ["--levels", str(LEVELS), "--attempts", "2"]
    return words + unlimited * [f"levels={LEVELS}"]


def commands(page: Path) -> list[list[str]]:
    lines = re.findall(r"^    (?:pip install \S+ && )?(levelproof .*)", page.read_text(), re.MULTILINE)
    return [smaller(line) for line in lines if not any(word in line for word in ELSEWHERE)]


def run_command(words: list[str], folder: Path, inline: bool) -> None:
    """Run a command in its own process if it starts workers, else in this one; `inline` jobs start none."""
    make_room()  # a page compiles as much as most modules
    inline &= words[0] in JOBS
    starts = words[0] in JOBS or "--repair" in words
    executor = [f"executor={'inline' if inline else 'ray'}"] if words[0] in JOBS else []
    done = (run if starts and not inline else here)([*words, *executor], folder)
    none_fits = done.returncode == 2 and any(text in done.stderr for text in NO_MATCH) and words[0] not in LEARNERS
    output = f"{done.stdout[-500:]}{done.stderr[-1500:]}"
    assert done.returncode == 0 or none_fits, f"levelproof {shlex.join(words)}: {output}"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with what pages presuppose: splits, level files, a policy, an agent, a folder for Kinetix."""
    folder = tmp_path_factory.mktemp("docs")
    for size, budget in (("s", "3k"), ("s", "4k"), ("s", "5k"), ("s", "6k"), ("m", "5k"), ("m", "6k")):
        run_command(["generate", f"size={size}", f"budget={budget}", f"levels={LEVELS}"], folder, True)
    run_command(["export", "data/4k/s", "7", "-o", "level.json"], folder, True)
    for name in ("mine", "handmade"):
        (folder / name).mkdir()
        shutil.copy(folder / "level.json", folder / name)
    run_command(smaller("levelproof clone data/4k/s -o policy"), folder, True)
    (folder / "agent.py").write_text("def act(observation, live, uniform):\n    return (2 * uniform).astype(int)\n")
    everything = ["--where", "shard IS NOT NULL"]
    run_command(["export", "data/6k/s", "--format", "kinetix", *everything, "-o", "kinetix/6k/s"], folder, True)
    return folder


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=lambda page: page.stem)
def test_commands_of_a_page_run_in_order(page: Path, made: Path, tmp_path: Path) -> None:
    (tmp_path / "manifests").symlink_to(ROOT / "manifests")
    for words in commands(page):
        for name in re.findall(
            r"data/\w+/\w+|kinetix/\w+/\w+|level\.json|agent\.py|\bmine\b|\bhandmade\b|\bpolicy\b", " ".join(words)
        ):
            makes = words[0] in ("import", "clone", "train", "distill") and f"-o {name}" in " ".join(words)
            if (made / name).exists() and not (tmp_path / name).exists() and not makes:
                copy = shutil.copytree if (made / name).is_dir() else shutil.copy
                (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
                copy(made / name, tmp_path / name)
        run_command(words, tmp_path, page.stem not in WITH_WORKERS)
