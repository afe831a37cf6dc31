"""Threads that take their first steps at the same time share one kernel."""

import os
import subprocess
import sys

from tests.golden.load import HERE

# Starts with no kernel, neither in the process nor kept by another: compiling takes long enough for all threads to ask
# for it meanwhile. The barrier lets them ask together
PROGRAM = """
import threading
import numpy as np
from levelproof.physics.step import step
from tests.physics.worlds import idle, room
given, barrier, found = (*room(), *idle()), threading.Barrier(6), {}

def first(thread):
    barrier.wait()
    try:
        after = step(*given, seen=False)[0]
        found[thread] = np.asarray(after.position).tobytes()
    except Exception as error:
        found[thread] = repr(error)

threads = [threading.Thread(target=first, args=[thread]) for thread in range(6)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
for thread in range(6):
    assert isinstance(found[thread], bytes), found[thread]
assert len(set(found.values())) == 1
"""


def test_first_steps_of_six_threads_succeed() -> None:
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    command = [sys.executable, "-c", PROGRAM]
    ran = subprocess.run(command, cwd=HERE.parents[1], env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
