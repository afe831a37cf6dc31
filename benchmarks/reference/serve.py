"""A contestant's half of a bench: a process that gets ready, then runs once for every line it reads.

Standard library only: the reference's scripts run in an environment that has nothing of ours, and import this file
as their neighbour.
"""

import json
import sys
import time
from collections.abc import Callable

MARK = "@"  # before our lines; libraries may print what they like


def serve(ready: dict, run: Callable[[], dict]) -> None:
    """Say what getting ready gave, then what each run gave, until the input ends."""
    _say(ready)
    for _ in sys.stdin:
        _say(run())


def answer(ready: dict, do: Callable[[dict], dict]) -> None:
    """The same for requests: each line read is one, as JSON, and `do` makes its answer."""
    _say(ready)
    for line in sys.stdin:
        _say(do(json.loads(line)))


def timed(action: Callable):
    """(seconds, result)."""
    start = time.perf_counter()
    result = action()
    return time.perf_counter() - start, result


def _say(facts: dict) -> None:
    print(MARK + json.dumps(facts), flush=True)
