"""Progress bar for loops."""

from collections.abc import Iterable
from typing import TypeVar

from rich.console import Console
from rich.progress import track

T = TypeVar("T")


def with_bar(parts: Iterable[T], label: str, count: int | None = None, minimum: int = 0) -> Iterable[T]:
    """Iterate over `parts`, with a progress bar on a terminal.

    Args:
        parts: items.
        label: text beside the bar.
        count: number of items, if `parts` has no length.
        minimum: smallest `count` for which a bar is shown.
    """
    if count is not None and count < minimum:
        return parts
    console = Console(stderr=True)
    return track(parts, label, count, console=console, transient=True, disable=not console.is_terminal)
