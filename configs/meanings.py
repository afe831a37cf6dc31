"""Every setting with its default, its meaning and its unit, as they stand side by side in the source.

A setting is a field of a frozen dataclass; what it means is the comment beside it, and a comment above fields heads
them. So whoever changes a default reads what it means, and there is one text to keep true.
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

from levelproof.configs.compose import chosen, presets, settings, typed_as
from levelproof.configs.convert import flat
from levelproof.configs.schema import JobConfig

JOB = "job"  # the group of settings without a dot


@dataclass(frozen=True)
class Setting:
    """What people may change, by the name that they type."""

    name: str
    default: Any  # of JSON's types; of a group of presets, the preset's name
    meaning: str  # with its unit
    choices: Mapping[str, str]  # each with its meaning or ""; empty: any value of the default's type
    group: str  # what it stands under

    @property
    def word(self) -> str:
        """Name and default, as people type it."""
        return typed_as(self.name, self.default)

    @property
    def text(self) -> str:
        """Meaning, and the choices that it does not name itself."""
        if all(choice in self.meaning for choice in self.choices):
            return self.meaning
        explained = [f"{choice}: {meaning}" if meaning else choice for choice, meaning in self.choices.items()]
        return f"{self.meaning} ({('; ' if any(self.choices.values()) else ', ').join(explained)})"


class Comment(NamedTuple):
    """What the source says of one name in the body of a class."""

    heading: str  # the comment above it or above an earlier name
    beside: str


def every_setting() -> list[Setting]:
    """All settings, in the order of the dataclasses: the job's own first, then group after group."""
    return list(_of(JobConfig, flat(settings([])), ""))


def comments_in(cls: type) -> dict[str, Comment]:
    """The comments on each field of a dataclass, or member of an enumeration, in order.

    Raises:
        OSError: the source is not there.
    """
    source = textwrap.dedent(inspect.getsource(cls))
    above, beside = {}, {}
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            (line, column), words = token.start, token.string.removeprefix("#").strip()
            (beside if token.line[:column].strip() else above)[line] = words
    (definition,) = ast.parse(source).body
    assert isinstance(definition, ast.ClassDef)
    found, heading, last = {}, "", definition.lineno
    for node in definition.body:
        lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
        heading = " ".join(above[line] for line in range(last + 1, node.lineno) if line in above) or heading
        last = lines[-1]
        match node:
            case ast.AnnAssign(target=ast.Name(name)) | ast.Assign(targets=[ast.Name(name)]):
                found[name] = Comment(heading, " ".join(beside[line] for line in lines if line in beside))
    return found


def _of(cls: type, defaults: Mapping[str, Any], path: str) -> Iterator[Setting]:
    """The settings of a dataclass, then those of the dataclasses among its fields."""
    hints, groups = get_type_hints(cls), []
    for field, (heading, meaning) in comments_in(cls).items():
        name = f"{path}.{field}" if path else field
        group = f"{path or JOB}: {heading}" if heading else path or JOB
        if not is_dataclass(hints[field]):
            yield Setting(name, defaults[name], meaning, _choices(hints[field]), group)
            continue
        groups.append((hints[field], name))
        if name in presets():
            yield Setting(name, chosen()[name], meaning, dict.fromkeys(presets()[name], ""), group)
    if not path:
        meaning = "one word for a set of settings"
        yield Setting("procedure", chosen()["procedure"], meaning, dict.fromkeys(presets()["procedure"], ""), JOB)
    for nested, name in groups:
        yield from _of(nested, defaults, name)


def _choices(hint: Any) -> dict[str, str]:
    if isinstance(hint, type) and issubclass(hint, Enum):
        return {hint[member].value: comment.beside for member, comment in comments_in(hint).items()}
    return dict.fromkeys(get_args(hint), "") if get_origin(hint) is Literal else {}
