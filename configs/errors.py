"""What is wrong with a setting."""

import difflib
from collections.abc import Iterable


class ConfigError(ValueError):
    """A setting is wrong; the message is one sentence that names it."""


def suggestion(word: str, known: Iterable[str]) -> str:
    """`' (did you mean x?)'` for the closest of `known`, else `''`."""
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f" (did you mean {close[0]}?)" if close else ""
