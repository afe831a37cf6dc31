"""Arguments that have another name now: the old one still works for a version, with a warning."""

import warnings
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])


def renamed(**names: str) -> Callable[[F], F]:
    """Let a function take arguments by their old names, too: `renamed(old="new")`.

    Raises:
        TypeError: a call gives both names of an argument.
    """

    def decorate(function: F) -> F:
        @wraps(function)
        def call(*args: Any, **given: Any) -> Any:
            for old in names.keys() & given.keys():
                new = names[old]
                if new in given:
                    raise TypeError(f"{function.__name__} got {new}= and {old}=, its old name: give {new}= alone")
                warnings.warn(
                    f"{old}= of {function.__name__} is now {new}=; the next version knows the new name alone",
                    DeprecationWarning,
                    stacklevel=2,
                )
                given[new] = given.pop(old)
            return function(*args, **given)

        return call  # pyright: ignore[reportReturnType]

    return decorate
