"""Cost of a manifest's levels, in total and per solved level."""

import pyarrow as pa
import pytest

from levelproof.experts.steps import Seconds
from levelproof.pipeline.look.cost import cost_of, describe_cost
from levelproof.pipeline.store.columns import COLUMNS


def table(labels: list[str], seconds: list[Seconds | None], device: str = "cpu: of some kind") -> pa.Table:
    spent = [None if entry is None else entry._asdict() for entry in seconds]
    columns = {"label": labels, "device": [device] * len(labels), "seconds": spent}
    return pa.table({name: pa.array(values, COLUMNS.field(name).type) for name, values in columns.items()})


def test_cost_per_solved_level_includes_unsolved_levels() -> None:
    spent = [Seconds(training=6.0), Seconds(training=1.0, writing=1.0), None, Seconds(search=4.0)]
    cost = cost_of(table(["unsolved", "solved", "solved", "solved"], spent))
    assert cost is not None
    assert (cost["of"], cost["levels"], cost["per_solved"]) == ("core", 3, pytest.approx(6.0))
    assert cost["seconds"] == Seconds(search=4.0, training=7.0, writing=1.0)._asdict()
    assert describe_cost(cost).startswith("12 core-seconds (0% sampling, 33% search, 58% training")
    assert describe_cost(cost).endswith(", 6 per solved level")


def test_cost_omits_what_was_not_measured_or_solved() -> None:
    assert cost_of(table(["solved"], [None])) is None
    cost = cost_of(table(["unsolved"], [Seconds(training=1.0)], "gpu: of some kind"))
    assert cost is not None
    assert (cost["of"], cost["per_solved"]) == ("GPU", None)
    assert "solved" not in describe_cost(cost)
