"""Jobs that are stopped or killed while experts train: the same command ends with the same bits, and repeats only the
training that was not saved."""

import re
import signal
import time
from pathlib import Path

import pytest

from levelproof.configs.compose import compose_job
from levelproof.pipeline.stopping import LAST
from levelproof.pipeline.store.paused import load_paused
from tests.pace import patience
from tests.pipeline.command import heed_ctrl_c, here, run, start, until
from tests.pipeline.made import lasting

LEVELS = 4
ALONE = ("search.env_steps=0", "stop.rule=budget", "expert.replays=0")  # so that experts train long
SETTINGS = [f"levels={LEVELS}", f"unit={LEVELS}", "budget=256k", *ALONE]
COMMAND = ["generate", *SETTINGS, "workers=1", "checkpoint=1s"]
SPLIT = Path("data/256k/s")

pytestmark = pytest.mark.campaign


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """Return the split of an undisturbed run, and its env steps."""
    folder = tmp_path_factory.mktemp("undisturbed")
    done = here(["generate", *SETTINGS, "executor=inline"], folder)
    assert done.returncode == 0, done.stderr
    return folder / SPLIT, env_steps(done.stdout)


def env_steps(out: str) -> int:
    match = re.search(r"^([0-9,]+) env steps: ", out, re.MULTILINE)
    assert match, out
    return int(match[1].replace(",", ""))


@pytest.mark.parametrize(
    ("executor", "number"),
    [("inline", signal.SIGINT), ("inline", signal.SIGKILL), ("ray", signal.SIGTERM), ("ray", signal.SIGKILL)],
)
def test_same_command_resumes_unfinished_experts(
    undisturbed: tuple[Path, int], tmp_path: Path, number: signal.Signals, executor: str
) -> None:
    split, command = tmp_path / SPLIT, [*COMMAND, f"executor={executor}"]
    process = start(command, tmp_path, preexec_fn=heed_ctrl_c)
    until(lambda: list(split.glob("checkpoints/[0-9]*.paused")), process)
    begin = time.monotonic()
    process.send_signal(number)
    _, err = process.communicate(timeout=patience(60))
    # The command's own timer ends it after LAST s on any machine; only its exit may take longer on a slow one
    assert time.monotonic() - begin < LAST + patience(2)
    assert process.returncode == (-9 if number == signal.SIGKILL else 130), err
    kept = load_paused(split, range(LEVELS), compose_job(SETTINGS))
    steps = sum(int(paused.expert.begun.training.progress.env_steps) for paused in kept.values())
    assert steps
    again = run(command, tmp_path)
    assert again.returncode == 0, again.stderr
    whole, total = undisturbed
    assert repr(lasting(split)) == repr(lasting(whole))
    assert env_steps(again.stdout) <= total - steps
    assert not list((split / "checkpoints").iterdir())
