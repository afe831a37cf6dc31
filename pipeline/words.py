"""Formatting numbers for display."""


def number(value: float) -> str:
    """Format a number with three significant digits, but all digits before the point: `0.383`, `12.3`, `12,345`."""
    return f"{value:,.0f}" if abs(value) >= 999.5 else f"{value:.3g}"


def duration(seconds: float) -> str:
    """Format a duration: `45 s`, `3 min`, `2.5 h`."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def many(count: int, noun: str) -> str:
    """Format a count with its noun: `1 level`, `2 witnesses`, `12,345 trajectories`."""
    plural = f"{noun[:-1]}ies" if noun.endswith("y") else f"{noun}{'es' if noun.endswith('s') else 's'}"
    return f"{count:,} {noun if count == 1 else plural}"
