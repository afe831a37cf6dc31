"""Conversion of Hydra's dictionaries to typed frozen dataclasses, and back to plain data for hashing.

cattrs structures values by the dataclasses' annotations. This module decides which types a value may have, and phrases
the errors; dataclasses check ranges themselves (`__post_init__` raises ValueError). No dictionary travels beyond this
module's callers.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from enum import StrEnum
from typing import Any, Literal, TypeVar, get_args, get_origin

from cattrs import BaseValidationError, Converter, ForbiddenExtraKeysError
from cattrs.errors import AttributeValidationNote
from cattrs.gen import make_dict_structure_fn

from levelproof.configs.errors import ConfigError, suggestion
from levelproof.configs.numbers import SCALES, parse_count

T = TypeVar("T")
CONVERTER = Converter()
SCALARS = {  # name for messages, and types of accepted values: a string setting accepts 1000
    bool: ("true or false", (bool,)),
    int: ("a whole number", (int,)),
    float: ("a number", (int, float)),
    str: ("text", (int, float, str)),
}


def typed(cls: type[T], values: Mapping[str, Any], path: str = "") -> T:
    """Return an instance of the dataclass `cls` from nested mappings; missing fields take their defaults.

    `path` names the group of the settings in messages.

    Raises:
        ConfigError: a key is unknown, a value has the wrong type, or the dataclass rejects it.
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"{path or 'the configuration'} is {values!r}, but must be a group of settings.")
    try:
        return CONVERTER.structure(values, cls)
    except BaseValidationError as error:
        raise ConfigError(_sentence(error, path)) from None


def plain(value: Any) -> Any:
    """Convert nested dataclasses and enumerations to JSON's types."""
    return CONVERTER.unstructure(value)


def flat(tree: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Flatten nested mappings: `{"a": {"b": 1}}` becomes `{"a.b": 1}`."""
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        name = _join(path, key)
        leaves |= flat(value, name) if isinstance(value, Mapping) else {name: value}
    return leaves


def nested(leaves: Mapping[str, Any]) -> dict[str, Any]:
    """Invert `flat`.

    Raises:
        ValueError: a name lies below that of a value.
    """
    tree: dict[str, Any] = {}
    for name, value in leaves.items():
        *groups, last = name.split(".")
        group = tree
        for part in groups:
            group = group.setdefault(part, {})
            if not isinstance(group, dict):
                raise ValueError(f"{name} lies below a value")
        group[last] = value
    return tree


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _sentence(error: Exception, path: str) -> str:
    """Describe the first error, with the name of its setting."""
    notes = [note for note in getattr(error, "__notes__", ()) if isinstance(note, AttributeValidationNote)]
    path = _join(path, notes[0].name) if notes else path
    match error:
        case BaseValidationError():
            return _sentence(error.exceptions[0], path)
        case ForbiddenExtraKeysError():
            key = min(error.extra_fields)
            return f"there is no setting {_join(path, key)}{suggestion(key, [f.name for f in fields(error.cl)])}."
        case KeyError():
            return f"{path} is missing."
        case ConfigError():
            return str(error)
    # A value's error continues the sentence after the setting's name; a dataclass's starts with its field's name
    return f"{path} {error}." if notes else f"{_join(path, str(error))}."


@CONVERTER.register_structure_hook_factory(is_dataclass)
def _group(cls: type) -> Callable[[Any, Any], Any]:
    build = make_dict_structure_fn(cls, CONVERTER, _cattrs_forbid_extra_keys=True)

    def read(value: Any, _: Any) -> Any:
        if not isinstance(value, Mapping):
            raise ValueError(f"is {value!r}, but must be a group of settings: set one of them, as in GROUP.NAME=VALUE")
        return build(value, cls)

    return read


@CONVERTER.register_structure_hook_factory(lambda hint: get_origin(hint) is Literal)
def _literal(hint: Any) -> Callable[[Any, Any], Any]:
    return lambda value, _: _one_of(get_args(hint), value)


def _member(value: Any, cls: type[StrEnum]) -> StrEnum:
    return cls(_one_of([member.value for member in cls], value))


def _one_of(choices: Sequence[Any], value: Any) -> Any:
    if value not in choices:
        names = [str(choice) for choice in choices]
        raise ValueError(f"is {value!r}: choose one of {', '.join(names)}{suggestion(str(value), names)}")
    return value


def _counted(value: Any) -> Any:
    """Parse suffixed counts such as 64k; return anything else unchanged."""
    if isinstance(value, str) and value[-1:] in SCALES:
        with suppress(ConfigError):
            return parse_count(value, "")
    return value


def _scalar(value: Any, kind: type) -> Any:
    wanted, types = SCALARS[kind]
    value = _counted(value) if kind is int else value
    if type(value) not in types or (kind is float and not abs(value) <= sys.float_info.max):
        raise ValueError(f"is {value!r}: it must be {wanted}")
    return kind(value)


CONVERTER.register_structure_hook(StrEnum, _member)
for _kind in SCALARS:
    CONVERTER.register_structure_hook(_kind, _scalar)
