"""Renamed arguments: the old name works for one more version, with a warning."""

import warnings
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])


def renamed(**names: str) -> Callable[[F], F]:
    """Make a function accept arguments by their old names, too: `renamed(old="new")`.

    Raises:
        TypeError: a call passes an argument under both names.
    """

    def decorate(function: F) -> F:
        @wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            for old in names.keys() & kwargs.keys():
                new = names[old]
                if new in kwargs:
                    raise TypeError(f"{function.__name__} got {new}= and {old}=, its old name: pass {new}= alone")
                warnings.warn(
                    f"{old}= of {function.__name__} is now {new}=; the next version accepts only the new name",
                    DeprecationWarning,
                    stacklevel=2,
                )
                kwargs[new] = kwargs.pop(old)
            return function(*args, **kwargs)

        return call  # pyright: ignore[reportReturnType]

    return decorate
