"""Cost of a manifest's levels: core-seconds or GPU-seconds by stage, in total and per solved level."""

from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float

from levelproof.experts.labels import Label
from levelproof.experts.steps import Seconds
from levelproof.pipeline.words import number

READ = ("label", "device", "seconds")  # manifest columns that cost_of needs


def cost_of(rows: pa.Table) -> dict[str, Any] | None:
    """Total the cost of rows with the columns READ, as JSON types; None if no row has seconds.

    `per_solved` divides the seconds of all rows, unsolved ones included, by the number of solved levels.
    """
    rows = rows.select(READ)
    if rows.column("seconds").null_count:  # rare; copying millions of rows takes memory
        rows = rows.filter(pc.is_valid(rows.column("seconds")))  # pyright: ignore[reportAttributeAccessIssue]
    if not rows.num_rows:
        return None
    seconds = {stage: pc.sum(pc.struct_field(rows.column("seconds"), stage)).as_py() for stage in Seconds._fields}  # pyright: ignore[reportAttributeAccessIssue]
    devices = {str(device).partition(":")[0] for device in rows.column("device").unique().to_pylist()}
    total, counts = sum(seconds.values()), rows.column("label").value_counts().to_pylist()
    solved = sum(entry["counts"] for entry in counts if entry["values"] == Label.SOLVED)
    return {
        "of": "core" if devices == {"cpu"} else "device" if "cpu" in devices else "GPU",
        "levels": rows.num_rows,
        "seconds": seconds,
        "per_solved": total / solved if solved else None,
    }


def seconds_of(rows: pa.Table) -> Float[np.ndarray, " row"]:
    """Sum each row's seconds over all stages; NaN if none were recorded."""
    stages = [pc.struct_field(rows.column("seconds"), stage).to_numpy() for stage in Seconds._fields]  # pyright: ignore[reportAttributeAccessIssue]
    return np.stack(stages).astype(np.float64).sum(0)


def describe_cost(cost: dict[str, Any]) -> str:
    """Describe a cost in words, to follow `cost: `."""
    total, each = sum(cost["seconds"].values()), cost["per_solved"]
    shares = ", ".join(f"{part / total:.0%} {stage}" for stage, part in cost["seconds"].items() if total)
    solved = "" if each is None else f", {number(each)} per solved level"
    return f"{total:,.0f} {cost['of']}-seconds ({shares}){solved}"
