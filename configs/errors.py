"""Errors in settings, and their messages."""

import difflib
from collections.abc import Iterable

MAX_LENGTH = 800  # characters of a message


class ConfigError(ValueError):
    """An invalid setting; the message is one sentence that names it."""

    def __str__(self) -> str:
        return readable(super().__str__())


def readable(message: str) -> str:
    """Return a message as one line of bounded length, without control characters, whatever it quotes."""
    line = "".join(c if c.isprintable() else " " if c.isspace() else "?" for c in message)
    return line if len(line) <= MAX_LENGTH else f"{line[: MAX_LENGTH // 2]} ... {line[-MAX_LENGTH // 2 :]}"


def suggestion(word: str, known: Iterable[str]) -> str:
    """Return `' (did you mean x?)'` for the word of `known` closest to `word`, or `''` if none is close."""
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f" (did you mean {close[0]}?)" if close else ""
