"""What people see while one thing after another is gone through."""

from collections.abc import Iterable
from typing import TypeVar

from rich.console import Console
from rich.progress import track

T = TypeVar("T")


def shown(parts: Iterable[T], words: str, count: int | None = None, least: int = 0) -> Iterable[T]:
    """The same, with a bar on a terminal.

    Args:
        parts: to go through.
        words: what they are.
        count: how many, where they do not tell themselves.
        least: fewer than so many take no time worth a bar.
    """
    if count is not None and count < least:
        return parts
    console = Console(stderr=True)
    return track(parts, words, count, console=console, transient=True, disable=not console.is_terminal)
