"""What is wrong with a setting."""

import difflib
from collections.abc import Iterable

LONGEST = 800  # characters of a message


class ConfigError(ValueError):
    """A setting is wrong; the message is one sentence that names it."""

    def __str__(self) -> str:
        return readable(super().__str__())


def readable(message: str) -> str:
    """A message in one line without anything that a terminal would obey, whatever it quotes, and not too long."""
    line = "".join(c if c.isprintable() else " " if c.isspace() else "?" for c in message)
    return line if len(line) <= LONGEST else f"{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}"


def suggestion(word: str, known: Iterable[str]) -> str:
    """`' (did you mean x?)'` for the closest of `known`, else `''`."""
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f" (did you mean {close[0]}?)" if close else ""
