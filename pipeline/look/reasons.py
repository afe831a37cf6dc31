"""Kinds of label reasons: reasons that differ only in their numbers are of one kind."""

import re

import pyarrow as pa


def kind_of_reason(reason: str) -> str:
    """Replace the numbers in a reason by N."""
    return re.sub(r"\d[\d,.]*\d|\d", "N", reason)


def kinds_of_reasons(reasons: pa.ChunkedArray) -> dict[str, int]:
    """Count the reasons of each kind, most frequent first."""
    counts: dict[str, int] = {}
    for entry in reasons.value_counts().to_pylist():
        kind = kind_of_reason(entry["values"])
        counts[kind] = counts.get(kind, 0) + entry["counts"]
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))
