"""Processes that share a cache folder compile a program once; a claim ends with its process."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from levelproof.pipeline.claims import claimed, try_claim
from tests.pace import patience
from tests.pipeline.command import ROOT, line_of

# Both processes start to compile at the same time; compiling takes about a second
COMPILE = """
from levelproof.pipeline.runtime import prepare_jax
prepare_jax()
import pathlib, sys, time
import jax
folder, mine, other = pathlib.Path(sys.argv[1]), *sys.argv[2:]
written = []
jax.monitoring.register_event_listener(lambda event, **_: written.append(event) if "cache_misses" in event else None)
def f(x):
    for i in range(150):
        x = jax.numpy.sin(x[::-1] * i) @ x
    return x
lowered = jax.jit(f).lower(jax.ShapeDtypeStruct((8, 8), "float32"))
(folder / mine).touch()
while not (folder / other).exists():
    time.sleep(0.01)
lowered.compile()
print(len(written))
"""
HOLD = """
import pathlib, sys, time
from levelproof.pipeline.claims import claimed
with claimed(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(1000)
"""


@pytest.mark.slow
def test_two_processes_compile_a_program_once(tmp_path: Path) -> None:
    script = tmp_path / "compile.py"
    script.write_text(COMPILE)
    environment = {"PYTHONPATH": str(ROOT), "LEVELPROOF_CACHE_DIR": str(tmp_path / "cache"), "PATH": ""}
    both = [
        subprocess.Popen([sys.executable, script, tmp_path, *names], env=environment, text=True, stdout=subprocess.PIPE)
        for names in (("one", "two"), ("two", "one"))
    ]
    counts = sorted(int(process.communicate(timeout=patience(120))[0]) for process in both)
    assert counts == [0, 1]
    programs = tmp_path / "cache" / "jax"
    assert list(programs.glob("jit_f-*-cache"))
    assert not list(programs.glob("*.claim"))


def test_claim_of_a_killed_process_is_free(tmp_path: Path) -> None:
    path = tmp_path / "program.claim"
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, path], env={"PYTHONPATH": str(ROOT), "PATH": ""}, stdout=subprocess.PIPE, text=True
    )
    assert line_of(holder, holder.stdout) == "held\n"
    assert try_claim(path) is None
    holder.send_signal(signal.SIGKILL)
    holder.communicate()
    start = time.monotonic()
    with claimed(path):
        assert time.monotonic() - start < patience(5)
    assert not path.exists()


def test_claim_in_a_missing_folder_costs_nothing(tmp_path: Path) -> None:
    with claimed(tmp_path / "missing" / "program.claim"):
        pass
