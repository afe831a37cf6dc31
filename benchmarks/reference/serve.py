"""A benchmark process's side of the protocol: it gets ready, then runs once for every line on standard input.

Imports the standard library only, because the reference's scripts import this file in an environment without ours.
"""

import json
import sys
import time
from collections.abc import Callable

MARK = "@"  # prefix of our lines; libraries may print others


def serve(ready: dict, run: Callable[[], dict]) -> None:
    """Print the facts `ready`, then those of a run for each line of input."""
    _say(ready)
    for _ in sys.stdin:
        _say(run())


def answer(ready: dict, do: Callable[[dict], dict]) -> None:
    """Print the facts `ready`, then the answer of `do` to each line of input, a JSON request."""
    _say(ready)
    for line in sys.stdin:
        _say(do(json.loads(line)))


def timed(action: Callable):
    """Call `action`; return (seconds, result)."""
    start = time.perf_counter()
    result = action()
    return time.perf_counter() - start, result


def _say(facts: dict) -> None:
    print(MARK + json.dumps(facts), flush=True)
