"""Threads that take their first steps at the same time share one kernel."""

import os
import subprocess
import sys

import pytest

from tests.golden.load import HERE
from tests.pace import patience

# No kernel exists yet, neither in the process nor on disk. Compiling takes long enough for all threads to ask for the
# kernel in the meantime; the barrier makes them ask together
PROGRAM = """
import threading
import numpy as np
from levelproof.physics.step import step
from tests.physics.worlds import idle, room
given, barrier, results = (*room(), *idle()), threading.Barrier(6), {}

def first(thread):
    barrier.wait()
    try:
        after = step(*given, with_contacts=False)[0]
        results[thread] = np.asarray(after.position).tobytes()
    except Exception as error:
        results[thread] = repr(error)

threads = [threading.Thread(target=first, args=[thread]) for thread in range(6)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
for thread in range(6):
    assert isinstance(results[thread], bytes), results[thread]
assert len(set(results.values())) == 1
"""


@pytest.mark.slow
def test_first_steps_of_six_threads_succeed() -> None:
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    command = [sys.executable, "-c", PROGRAM]
    ran = subprocess.run(
        command, cwd=HERE.parents[1], env=environment, capture_output=True, text=True, timeout=patience(1800)
    )
    assert ran.returncode == 0, ran.stderr
