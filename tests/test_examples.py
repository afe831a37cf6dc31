"""The scripts of docs/examples: their commands are valid, and they work with stand-ins for a cluster's programs."""

import os
import re
import shlex
import signal
import subprocess
from pathlib import Path

import pytest
import yaml

from levelproof.configs.compose import compose_job
from tests.pace import patience, wait_until

FOLDER = Path(__file__).parent.parent / "docs" / "examples"
SCRIPTS = sorted(FOLDER.glob("*.sh"))
VALUES = {"$size": "s"}


def commands(path: Path) -> list[list[str]]:
    """Return the arguments of every command `levelproof generate`."""
    lines = re.findall(r"levelproof generate (.*?)(?: &)?$", path.read_text(), re.MULTILINE)
    return [[re.sub(r"\$\w+", lambda name: VALUES[name[0]], word) for word in shlex.split(line)] for line in lines]


@pytest.mark.parametrize("path", sorted(FOLDER.iterdir()), ids=lambda path: path.name)
def test_examples_use_valid_settings(path: Path) -> None:
    assert commands(path)
    for words in commands(path):
        assert compose_job(words).checkpoint_seconds == 600


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.name)
def test_scripts_parse(path: Path) -> None:
    subprocess.run(["bash", "-n", str(path)], check=True, timeout=patience(1800))


def test_kubernetes_example_is_a_ray_job() -> None:
    job = yaml.safe_load((FOLDER / "kubernetes.yaml").read_text())
    assert (job["apiVersion"], job["kind"]) == ("ray.io/v1", "RayJob")
    cluster = job["spec"]["rayClusterSpec"]
    pods = [cluster["headGroupSpec"], *cluster["workerGroupSpecs"]]
    for pod in (group["template"]["spec"] for group in pods):
        (container,) = pod["containers"]
        names = {volume["name"] for volume in pod["volumes"]}
        assert {mount["name"] for mount in container["volumeMounts"]} == names
        assert [mount["mountPath"] for mount in container["volumeMounts"]] == ["/data"]
    assert "out=/data" in job["spec"]["entrypoint"]


@pytest.fixture
def stand_ins(tmp_path: Path) -> dict[str, str]:
    """Return an environment whose programs log their calls, and whose `levelproof` exits with the next code in the file
    `codes`, or on SIGTERM."""
    program = '#!/bin/bash\necho "${0##*/} $*" >> log\n'
    ends = (
        "trap 'echo stopped >> log; exit 130' TERM\n"
        "read -r code < codes; sed -i 1d codes\n"
        '[ "$code" = wait ] && { touch waits; while :; do sleep 0.1; done; }\nexit "$code"\n'
    )
    for name, does in {
        "levelproof": ends,
        "srun": "",
        "ray": "",
        "scontrol": '[ "$1" = show ] && echo a b | xargs -n1',
    }.items():
        (tmp_path / name).write_text(program + does)
        (tmp_path / name).chmod(0o755)
    slurm = {"SLURM_JOB_NODELIST": "a,b", "SLURM_CPUS_PER_TASK": "2", "SLURM_JOB_ID": "7"}
    array = {"SLURM_ARRAY_TASK_ID": "1", "SLURM_ARRAY_JOB_ID": "7"}
    return os.environ | slurm | array | {"PATH": f"{tmp_path}:{os.environ['PATH']}", "PAUSE": "0"}


def test_kubernetes_example_counts_quarantined_units_as_done(tmp_path: Path, stand_ins: dict[str, str]) -> None:
    command = yaml.safe_load((FOLDER / "kubernetes.yaml").read_text())["spec"]["entrypoint"]
    quoted = subprocess.list2cmdline(shlex.split(command))  # as Ray did before it used `shlex.join`
    for code, is_done in (0, True), (3, True), (1, False):
        (tmp_path / "codes").write_text(f"{code}\n")
        done = subprocess.run(["sh", "-c", quoted], cwd=tmp_path, env=stand_ins, timeout=patience(60))
        assert (done.returncode == 0) == is_done


def log(folder: Path) -> list[str]:
    return (folder / "log").read_text().splitlines()


def test_spot_script_repeats_the_command_until_it_is_done(tmp_path: Path, stand_ins: dict[str, str]) -> None:
    (tmp_path / "codes").write_text("137\n130\n0\n")
    done = subprocess.run(["bash", str(FOLDER / "spot.sh")], cwd=tmp_path, env=stand_ins, timeout=patience(60))
    assert done.returncode == 0
    first, second, third = log(tmp_path)
    assert first == second == third
    (tmp_path / "codes").write_text("2\n")
    assert (
        subprocess.run(["bash", str(FOLDER / "spot.sh")], cwd=tmp_path, env=stand_ins, timeout=patience(60)).returncode
        == 2
    )


@pytest.mark.parametrize(("name", "again"), [("slurm-array", "requeue 7_1"), ("slurm-ray", "requeue 7"), ("spot", "")])
def test_scripts_stop_the_command_at_the_end_of_an_allocation_and_requeue_it(
    tmp_path: Path, stand_ins: dict[str, str], name: str, again: str
) -> None:
    (tmp_path / "codes").write_text("wait\n")
    process = subprocess.Popen(["bash", str(FOLDER / f"{name}.sh")], cwd=tmp_path, env=stand_ins)
    wait_until((tmp_path / "waits").exists, 60, name)
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=patience(60)) == (0 if again else 130)
    assert "stopped" in log(tmp_path)
    assert not again or log(tmp_path)[-1] == f"scontrol {again}"
    if name == "slurm-ray":
        started = [line for line in log(tmp_path) if "ray start" in line]
        assert all("--object-store-memory=" in line for line in started)
        assert any("--nodelist=a" in line and "--head --port=6379" in line for line in started)
        assert any("--nodelist=b" in line and "--address=a:6379" in line for line in started)
