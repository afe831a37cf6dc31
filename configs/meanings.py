"""Every setting with its default, meaning and unit, read from the source.

A setting is a field of a frozen dataclass. The comment beside it is its meaning; a comment above it heads that field
and those that follow. So an author who changes a default sees its meaning, and only one text must be kept true.
"""

import ast
import inspect
import io
import textwrap
import tokenize
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, is_dataclass
from enum import Enum
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

from levelproof.configs.compose import default_presets, override_of, presets, settings
from levelproof.configs.convert import flat
from levelproof.configs.schema import JobConfig

JOB = "job"  # the group of settings without a dot


@dataclass(frozen=True)
class Setting:
    """A setting or group of presets, as users see it."""

    name: str  # as typed, with dots
    default: Any  # one of JSON's types; for presets, the preset's name
    meaning: str  # with its unit
    choices: Mapping[str, str]  # meaning of each choice, or ""; empty: any value of the default's type
    group: str  # heading under which it is listed

    @property
    def override(self) -> str:
        """Name and default, as users type them."""
        return override_of(self.name, self.default)

    @property
    def text(self) -> str:
        """Meaning, followed by all choices unless the meaning names them."""
        if all(choice in self.meaning for choice in self.choices):
            return self.meaning
        explained = [f"{choice}: {meaning}" if meaning else choice for choice, meaning in self.choices.items()]
        return f"{self.meaning} ({('; ' if any(self.choices.values()) else ', ').join(explained)})"


class Comment(NamedTuple):
    """The comments on one name in the body of a class."""

    heading: str  # the last comment above it or above an earlier name
    beside: str  # the comments on its own lines


def every_setting() -> list[Setting]:
    """Return all settings in the order of the dataclasses: the job's own first, then group after group."""
    return list(_settings_of(JobConfig, flat(settings([])), ""))


def comments_in(cls: type) -> dict[str, Comment]:
    """Return the comments on each field of a dataclass, or member of an enumeration, in order.

    Raises:
        OSError: the source is missing.
    """
    source = textwrap.dedent(inspect.getsource(cls))
    above, beside = {}, {}
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            (line, column), text = token.start, token.string.removeprefix("#").strip()
            (beside if token.line[:column].strip() else above)[line] = text
    (definition,) = ast.parse(source).body
    assert isinstance(definition, ast.ClassDef)
    comments, heading, last = {}, "", definition.lineno
    for node in definition.body:
        lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
        heading = " ".join(above[line] for line in range(last + 1, node.lineno) if line in above) or heading
        last = lines[-1]
        match node:
            case ast.AnnAssign(target=ast.Name(name)) | ast.Assign(targets=[ast.Name(name)]):
                comments[name] = Comment(heading, " ".join(beside[line] for line in lines if line in beside))
    return comments


def _settings_of(cls: type, defaults: Mapping[str, Any], path: str) -> Iterator[Setting]:
    """Yield the settings of a dataclass, then those of the dataclasses among its fields."""
    hints, groups = get_type_hints(cls), []
    for field, (heading, meaning) in comments_in(cls).items():
        name = f"{path}.{field}" if path else field
        group = f"{path or JOB}: {heading}" if heading else path or JOB
        if not is_dataclass(hints[field]):
            yield Setting(name, defaults[name], meaning, _choices(hints[field]), group)
            continue
        groups.append((hints[field], name))
        if name in presets():
            yield Setting(name, default_presets()[name], meaning, dict.fromkeys(presets()[name], ""), group)
    if not path:
        meaning, names = "preset of search, expert and stop settings", presets()["procedure"]
        yield Setting("procedure", default_presets()["procedure"], meaning, dict.fromkeys(names, ""), JOB)
    for nested, name in groups:
        yield from _settings_of(nested, defaults, name)


def _choices(hint: Any) -> dict[str, str]:
    if isinstance(hint, type) and issubclass(hint, Enum):
        return {hint[member].value: comment.beside for member, comment in comments_in(hint).items()}
    return dict.fromkeys(get_args(hint), "") if get_origin(hint) is Literal else {}
