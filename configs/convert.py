"""From Hydra's dictionaries to typed frozen dataclasses, and back to plain data for hashing.

Every value is checked against the dataclass's annotations, ranges by its own `__post_init__`
(which raises ValueError). No dictionary travels beyond this module's callers.
"""

import dataclasses
import math
import types
from collections.abc import Iterable, Mapping
from enum import Enum
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from configs.errors import ConfigError, suggestion

T = TypeVar("T")


def typed(cls: type[T], values: Mapping[str, Any], path: str = "") -> T:
    """An instance of the dataclass `cls` from nested mappings; what is missing takes its default.

    Raises:
        ConfigError: an unknown key, a value of the wrong type, or one that the dataclass refuses.
    """
    hints = get_type_hints(cls)
    names = [field.name for field in dataclasses.fields(cls)]  # type: ignore[arg-type]
    for key in values:
        if key not in names:
            raise ConfigError(f"there is no setting {_join(path, str(key))}{suggestion(str(key), names)}.")
    arguments = {name: _value(hints[name], values[name], _join(path, name)) for name in names if name in values}
    try:
        return cls(**arguments)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"{_join(path, '')}{error}") from None
    except TypeError as error:  # a field without a default was not given
        raise ConfigError(f"{path or cls.__name__} is incomplete: {error}.") from None


def plain(value: Any) -> Any:
    """Nested dataclasses, tuples and enums as JSON's types."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Enum):
        return value.name.lower()
    if isinstance(value, (tuple, list)):
        return [plain(item) for item in value]
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    return value


def flat(tree: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """`{"a": {"b": 1}}` as `{"a.b": 1}`."""
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        name = _join(path, key)
        leaves |= flat(value, name) if isinstance(value, Mapping) else {name: value}
    return leaves


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _value(hint: Any, value: Any, path: str) -> Any:
    """`value` as the annotated type `hint`."""
    origin, arguments = get_origin(hint), get_args(hint)
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, Mapping):
            raise ConfigError(
                f"{path} is {value!r}, but it is a group of settings: set one of them, as in {path}.NAME=VALUE."
            )
        return typed(hint, value, path)  # type: ignore[arg-type]
    if origin in (Union, types.UnionType):
        return _alternative(arguments, value, path)
    if origin is Literal:
        if value not in arguments:
            choices = ", ".join(map(str, arguments))
            raise ConfigError(
                f"{path} is {value!r}: choose one of {choices}{suggestion(str(value), map(str, arguments))}."
            )
        return value
    if origin is tuple:
        return _tuple(arguments, value, path)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return _value(Literal[tuple(member.name.lower() for member in hint)], value, path) and hint[str(value).upper()]
    return _scalar(hint, value, path)


def _alternative(hints: tuple[Any, ...], value: Any, path: str) -> Any:
    """The first of several types that fits; `None` only where it is one of them."""
    if value is None and type(None) in hints:
        return None
    errors = []
    for hint in hints:
        if hint is type(None):
            continue
        try:
            return _value(hint, value, path)
        except ConfigError as error:
            errors.append(error)
    raise errors[0]


def _tuple(hints: tuple[Any, ...], value: Any, path: str) -> tuple[Any, ...]:
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise ConfigError(f"{path} is {value!r}: write a list, as in {path}=[1,2].")
    items = list(value)
    kinds = [hints[0]] * len(items) if len(hints) == 2 and hints[1] is Ellipsis else list(hints)
    if len(kinds) != len(items):
        raise ConfigError(f"{path} has {len(items)} entries: it needs {len(kinds)}.")
    return tuple(_value(kind, item, f"{path}[{i}]") for i, (kind, item) in enumerate(zip(kinds, items, strict=True)))


SCALARS = {bool: "true or false", int: "a whole number", float: "a number", str: "a word"}


def _scalar(hint: Any, value: Any, path: str) -> Any:
    if hint not in SCALARS:
        raise TypeError(f"{path}: no rule to read a {hint} from a configuration")
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if hint is float and is_number and math.isfinite(value):
        return float(value)
    if hint is str and is_number:  # 1000 is a fine word where words are wanted
        return str(value)
    if hint is not float and type(value) is hint:
        return value
    raise ConfigError(f"{path} is {value!r}: it must be {SCALARS[hint]}.")
