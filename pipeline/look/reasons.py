"""What labels rest on, whatever the numbers in it: levels have few kinds of reasons and many numbers."""

import re

import pyarrow as pa


def kind_of_reason(reason: str) -> str:
    """What a reason says, with N for its numbers."""
    return re.sub(r"\d[\d,.]*\d|\d", "N", reason)


def kinds_of_reasons(reasons: pa.ChunkedArray) -> dict[str, int]:
    """How often each kind is there, the most frequent first."""
    counts: dict[str, int] = {}
    for entry in reasons.value_counts().to_pylist():
        kind = kind_of_reason(entry["values"])
        counts[kind] = counts.get(kind, 0) + entry["counts"]
    return dict(sorted(counts.items(), key=lambda of: (-of[1], of[0])))
