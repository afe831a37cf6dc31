"""The one package that users import: its names are there, are what they say, and cost nothing until they are used."""

import ast
import importlib
import inspect
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

import levelproof

SOURCE = Path(levelproof.__file__)


def imported_for_the_checker() -> dict[str, str]:
    """Name -> module, as a type checker reads them."""
    (block,) = [
        node
        for node in ast.parse(SOURCE.read_text()).body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    ]
    return {name.name: node.module for node in block.body if isinstance(node, ast.ImportFrom) for name in node.names}  # type: ignore[misc]


def test_what_is_listed_is_what_is_there_and_what_a_type_checker_sees() -> None:
    assert set(levelproof.__all__) == set(dir(levelproof)) == set(levelproof.HOME)
    assert imported_for_the_checker() == levelproof.HOME


@pytest.mark.parametrize("name", levelproof.__all__)
def test_every_name_is_the_one_of_its_home_and_says_what_it_is(name: str) -> None:
    value = getattr(levelproof, name)
    assert value is getattr(importlib.import_module(levelproof.HOME[name]), name)
    if callable(value):
        assert len(inspect.getdoc(value) or "") > 40
        assert not (inspect.getdoc(value) or "").startswith(f"{name}("), "dataclasses' own docstring says nothing"


def test_the_version_is_that_of_the_installed_package() -> None:
    assert levelproof.__version__ == version("levelproof")


def test_a_name_that_is_none_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'levelproof' has no attribute 'sample'"):
        levelproof.sample  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]


def test_importing_it_imports_nothing_heavy() -> None:
    program = "import sys, levelproof; print({'jax', 'numpy', 'ray', 'zarr'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", program], cwd=SOURCE.parents[1], capture_output=True, text=True)
    assert done.stdout.strip() == "set()", done.stderr


def test_type_checkers_are_told_that_it_has_types() -> None:
    assert SOURCE.with_name("py.typed").is_file()


def test_what_is_raised_can_be_caught_by_its_name_at_the_door(tmp_path: Path) -> None:
    with pytest.raises(levelproof.UserError, match="There is no split"):
        levelproof.open(tmp_path / "none")
    with pytest.raises(levelproof.LevelFileError):
        levelproof.read_level_file(tmp_path / "none.json")
    assert issubclass(levelproof.Failure, levelproof.LevelproofError)
