"""The structures that a handler reads match XLA's C header, which jaxlib ships."""

import ctypes
import re
from pathlib import Path

import jaxlib
import pytest

from levelproof.physics.codegen import ffi

HEADER = Path(jaxlib.__file__).parent / "include" / "xla" / "ffi" / "api" / "c_api.h"
READ = (ffi.ExtensionBase, ffi.ApiVersion, ffi.Metadata, ffi.MetadataExtension)
READ += (ffi.FrameBuffer, ffi.Args, ffi.Rets, ffi.CallFrame)
NUMBERS = {
    "size_t": ctypes.c_size_t,
    "int": ctypes.c_int,
    "int64_t": ctypes.c_int64,
    "XLA_FFI_Handler_Traits": ctypes.c_uint32,
}


@pytest.fixture(scope="module")
def header() -> str:
    """Return the header without comments."""
    return re.sub(r"//.*", "", HEADER.read_text())


def declared(header: str, name: str) -> list[tuple[str, str]]:
    """Return type and name of each field of a structure."""
    match = re.search(rf"\bstruct {name} {{(.*?)}}", header, re.DOTALL)
    assert match, f"{HEADER} has no {name}"
    fields = re.findall(r"([\w\s]+?[\s*]+)(\w+);", match[1])
    return [(re.sub(r"\b(const|struct)\b", "", kind).strip(), field) for kind, field in fields]


def kind_of(header: str, name: str) -> type:
    """Return the ctypes type of a C type."""
    if name.endswith("*"):
        return ctypes.c_void_p
    if name in NUMBERS:
        return NUMBERS[name]
    if re.search(rf"typedef enum {{[^}}]*}} {name};", header):
        return ctypes.c_int
    if re.search(rf"\bstruct {name} {{", header):
        return structure(header, name)
    raise AssertionError(f"{HEADER} has a type that this test does not know: {name}")


def structure(header: str, name: str) -> type[ctypes.Structure]:
    fields = [(field, kind_of(header, kind)) for kind, field in declared(header, name)]
    return type(name, (ctypes.Structure,), {"_fields_": fields})


@pytest.mark.parametrize("ours", READ)
def test_structure_fields_have_the_headers_offsets(header: str, ours: type[ctypes.Structure]) -> None:
    theirs = structure(header, ours.__name__)
    assert len(theirs._fields_) >= len(ours._fields_) > 0
    for name, kind, *_ in ours._fields_:
        mine, their = getattr(ours, name), getattr(theirs, name)
        message = f"{theirs.__name__}.{name} is not where physics/codegen/ffi.py has it: write down the header's fields"
        assert (mine.offset, mine.size) == (their.offset, their.size), message
        assert issubclass(kind, ctypes.Structure) == issubclass(dict(theirs._fields_)[name], ctypes.Structure)


def test_handler_announces_the_headers_version(header: str) -> None:
    """A new version may give the same fields another meaning: read what changed before announcing it."""
    version = {name: int(number) for name, number in re.findall(r"#define XLA_FFI_API_(MAJOR|MINOR) (\d+)", header)}
    assert version == {"MAJOR": ffi.VERSION_MAJOR, "MINOR": ffi.VERSION_MINOR}
    query = re.search(r"XLA_FFI_Extension_Metadata = (\d+)", header)
    assert query
    assert int(query[1]) == ffi.METADATA_QUERY


def test_header_comparison_notices_a_moved_field(header: str) -> None:
    """Move one field of the header."""
    moved = header.replace("XLA_FFI_ExecutionStage stage;", "int64_t more; XLA_FFI_ExecutionStage stage;")
    assert moved != header
    with pytest.raises(AssertionError, match=r"CallFrame\.stage is not where"):
        test_structure_fields_have_the_headers_offsets(moved, ffi.CallFrame)
