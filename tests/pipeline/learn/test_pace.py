"""The pace of a run: compiling and time spent aside do not count."""

import pytest

from levelproof.pipeline.learn import pace as module
from levelproof.pipeline.learn.pace import Pace


def test_pace_leaves_out_what_precedes_the_first_count_and_time_aside(monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: seconds[0])
    pace = Pace()
    seconds[0] = 60.0
    assert pace.count(500) == 0
    with pace.aside():
        seconds[0] += 30.0
    seconds[0] += 2.0
    assert pace.count(10) == 5
    seconds[0] += 3.0
    assert pace.count(40) == 10
