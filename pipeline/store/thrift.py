"""Parser for the numbers in parquet's footer and page headers, to check them before a library trusts them.

Both are structs of Thrift's compact protocol: for each field a byte with the difference to the last field's number and
its type, then its value; a zero byte ends the struct. Numbers are zigzag varints; a list is a byte with its length and
type, then its values.
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

TRUE, FALSE, I8, I16, I32, I64, DOUBLE, TEXT, LIST, SET, STRUCT = 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12
LONG = 15  # lists of at least this length have it in a varint
# Fields to read, by number: a type, the fields of a struct, or in a list those of its structs
Fields = Mapping[int, "int | Fields | list[Fields]"]

COLUMN: Fields = {5: I64, 7: I64, 9: I64, 11: I64}
VALUES, PACKED, FIRST, DICTIONARY = COLUMN  # number; bytes of all pages; offset of the data; of the dictionary
GROUP: Fields = {1: [{3: COLUMN}], 3: I64}
FOOTER: Fields = {3: I64, 4: [GROUP], 6: TEXT}
PAGE: Fields = {1: I32, 2: I32, 3: I32, 5: {1: I32, 2: I32}, 7: {1: I32, 2: I32}}
PLAIN = 0  # encoding: values one after another
COUNTED = {0: 5, 2: 7}  # field of a page header that counts values, by kind of page (data, dictionary)


class Column(NamedTuple):
    """A column chunk, as the footer describes it."""

    values: int
    first: int  # offset in the file
    length: int  # bytes
    has_dictionary: bool


class Group(NamedTuple):
    """A row group, as the footer describes it."""

    rows: int
    columns: list[Column]


class Footer(NamedTuple):
    """A file, as its footer describes it."""

    rows: int
    groups: list[Group]
    made_by: str


class Page(NamedTuple):
    """A page, as its header describes it."""

    is_dictionary: bool
    bytes: int  # decompressed
    values: int
    encoding: int


def footer_in(data: bytes) -> Footer:
    """Parse a footer. Raises ValueError or LookupError if Arrow never writes one like it."""
    fields, _ = _struct(data, 0, FOOTER)
    groups = [Group(group[3], [_column(column[3]) for column in group[1]]) for group in fields[4]]
    return Footer(fields[3], groups, fields[6].decode())


def _column(fields: Mapping[int, int]) -> Column:
    has_dictionary = fields.get(DICTIONARY, 0) > 0
    first = min(fields[FIRST], fields[DICTIONARY]) if has_dictionary else fields[FIRST]
    return Column(fields[VALUES], first, fields[PACKED], has_dictionary)


def pages_in(chunk: bytes) -> Iterator[Page]:
    """Yield all pages of a column chunk.

    Raises:
        ValueError, LookupError: it is not a sequence of complete pages as Arrow writes them.
    """
    at = 0
    while at < len(chunk):
        header, at = _struct(chunk, at, PAGE)
        kind, unpacked, packed = header[1], header[2], header[3]
        counted = header[COUNTED[kind]]
        values = counted[1]
        at += packed
        if min(unpacked, packed, values) < 0 or at > len(chunk):
            raise ValueError("a page header has wrong sizes")
        yield Page(kind == 2, unpacked, values, counted[2])


def _struct(data: bytes, at: int, wanted: Fields) -> tuple[dict[int, Any], int]:
    """Parse the wanted fields of the struct at offset `at`; return them and its end.

    Field numbers must ascend, so that each occurs once: of two, Thrift would take the last.
    """
    fields: dict[int, Any] = {}
    number = 0
    while head := data[at]:
        if head < 16:
            raise ValueError("its fields are not ordered by number")
        number, kind = number + (head >> 4), head & 15
        how = wanted.get(number)
        if how is None:
            _, at = _value(data, at + 1, kind, {})
            continue
        if kind != (how if isinstance(how, int) else STRUCT if isinstance(how, Mapping) else LIST):
            raise ValueError("one of its fields has the wrong type")
        inside = how[0] if isinstance(how, list) else how
        fields[number], at = _value(data, at + 1, kind, inside if isinstance(inside, Mapping) else {})
    return fields, at + 1


def _value(data: bytes, at: int, kind: int, wanted: Fields) -> tuple[Any, int]:
    """Parse the value at offset `at`; return it and its end. Structs, also in lists, keep only the wanted fields."""
    if kind in (TRUE, FALSE):
        return kind == TRUE, at
    if kind in (I16, I32, I64):
        number, at = _varint(data, at)
        if kind != I64 and number >> 32:
            raise ValueError("one of its numbers is too large")
        return number >> 1 ^ -(number & 1), at
    if kind == TEXT:
        length, at = _varint(data, at)
        return data[at : at + length], at + length
    if kind == STRUCT:
        return _struct(data, at, wanted)
    if kind in (LIST, SET):
        length, inner, at = data[at] >> 4, data[at] & 15, at + 1
        if length == LONG:
            length, at = _varint(data, at)
        if length > len(data) - at or (wanted and inner != STRUCT):
            raise ValueError("one of its lists is longer than the remaining bytes, or has the wrong type")
        values = []
        for _ in range(length):
            value, at = (None, at + 1) if inner in (TRUE, FALSE) else _value(data, at, inner, wanted)
            if wanted:
                values.append(value)
        return values, at
    if kind in (I8, DOUBLE):
        return None, at + (1 if kind == I8 else 8)
    raise ValueError("one of its fields has a type that Arrow does not write")


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = data[at]
    if value < 128:  # the common case
        return value, at + 1
    value, shift = value & 127, 7
    while (byte := data[at := at + 1]) > 127:
        value |= (byte & 127) << shift
        shift += 7
        if shift > 63:
            raise ValueError("one of its numbers is too large")
    return value | byte << shift, at + 1
