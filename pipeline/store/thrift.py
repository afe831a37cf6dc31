"""Numbers in parquet's footer and in the headers of its pages, before a library that believes them sees either.

Both are structs of Thrift's compact protocol: for each field a byte with the distance to its number and its type, then
its value, until a byte of zero. Numbers are varints, zigzag; a list is a byte with its length and type, then values.
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

TRUE, FALSE, I8, I16, I32, I64, DOUBLE, TEXT, LIST, SET, STRUCT = 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12
LONG = 15  # a list of at least so many has its length in a varint
# Fields that are read, by their numbers: a type, or the fields of a struct, or of those in a list
Fields = Mapping[int, "int | Fields | list[Fields]"]

COLUMN: Fields = {5: I64, 7: I64, 9: I64, 11: I64}
VALUES, PACKED, FIRST, DICTIONARY = COLUMN  # how many; bytes of all pages; where they start; where a dictionary does
GROUP: Fields = {1: [{3: COLUMN}], 3: I64}
FOOTER: Fields = {3: I64, 4: [GROUP], 6: TEXT}
PAGE: Fields = {1: I32, 2: I32, 3: I32, 5: {1: I32, 2: I32}, 7: {1: I32, 2: I32}}
PLAIN = 0  # the encoding in which values stand one after another
COUNTED = {0: 5, 2: 7}  # kinds of pages, of data and dictionaries: where the number of values stands


class Column(NamedTuple):
    """What a footer says of a column's chunk."""

    values: int
    first: int  # byte of the file
    length: int  # bytes
    has_dictionary: bool


class Group(NamedTuple):
    """What a footer says of a group of rows."""

    rows: int
    columns: list[Column]


class Footer(NamedTuple):
    """What a footer says of a file."""

    rows: int
    groups: list[Group]
    made_by: str


class Page(NamedTuple):
    """What the header of a page says."""

    is_dictionary: bool
    bytes: int  # unpacked
    values: int
    encoding: int


def footer_in(data: bytes) -> Footer:
    """Raises ValueError or LookupError where it is none that Arrow writes."""
    fields, _ = _struct(data, 0, FOOTER)
    groups = [Group(group[3], [_column(column[3]) for column in group[1]]) for group in fields[4]]
    return Footer(fields[3], groups, fields[6].decode())


def _column(fields: Mapping[int, int]) -> Column:
    has_dictionary = fields.get(DICTIONARY, 0) > 0
    first = min(fields[FIRST], fields[DICTIONARY]) if has_dictionary else fields[FIRST]
    return Column(fields[VALUES], first, fields[PACKED], has_dictionary)


def pages_in(chunk: bytes) -> Iterator[Page]:
    """All pages of a column's chunk.

    Raises:
        ValueError, LookupError: it is not pages from its first byte to its last, as Arrow writes them.
    """
    at = 0
    while at < len(chunk):
        header, at = _struct(chunk, at, PAGE)
        kind, unpacked, packed = header[1], header[2], header[3]
        counted = header[COUNTED[kind]]
        values = counted[1]
        at += packed
        if min(unpacked, packed, values) < 0 or at > len(chunk):
            raise ValueError("a header of its pages lies about sizes")
        yield Page(kind == 2, unpacked, values, counted[2])


def _struct(data: bytes, at: int, wanted: Fields) -> tuple[dict[int, Any], int]:
    """The wanted fields of the struct at a byte, and where it ends. Each stands once: Thrift takes the last of two."""
    fields: dict[int, Any] = {}
    number = 0
    while head := data[at]:
        if head < 16:
            raise ValueError("its fields are not in the order of their numbers")
        number, kind = number + (head >> 4), head & 15
        how = wanted.get(number)
        if how is None:
            _, at = _value(data, at + 1, kind, {})
            continue
        if kind != (how if isinstance(how, int) else STRUCT if isinstance(how, Mapping) else LIST):
            raise ValueError("a field of it is of another type")
        inside = how[0] if isinstance(how, list) else how
        fields[number], at = _value(data, at + 1, kind, inside if isinstance(inside, Mapping) else {})
    return fields, at + 1


def _value(data: bytes, at: int, kind: int, wanted: Fields) -> tuple[Any, int]:
    """The value at a byte, and where it ends; of structs, and of those in a list, the wanted fields."""
    if kind in (TRUE, FALSE):
        return kind == TRUE, at
    if kind in (I16, I32, I64):
        number, at = _varint(data, at)
        if kind != I64 and number >> 32:
            raise ValueError("a number of it is too large")
        return number >> 1 ^ -(number & 1), at
    if kind == TEXT:
        length, at = _varint(data, at)
        return data[at : at + length], at + length
    if kind == STRUCT:
        return _struct(data, at, wanted)
    if kind in (LIST, SET):
        length, of, at = data[at] >> 4, data[at] & 15, at + 1
        if length == LONG:
            length, at = _varint(data, at)
        if length > len(data) - at or (wanted and of != STRUCT):
            raise ValueError("a list of it is longer than the rest of it, or of another type")
        found = []
        for _ in range(length):
            value, at = (None, at + 1) if of in (TRUE, FALSE) else _value(data, at, of, wanted)
            if wanted:
                found.append(value)
        return found, at
    if kind in (I8, DOUBLE):
        return None, at + (1 if kind == I8 else 8)
    raise ValueError("a field of it is of no type that Arrow writes")


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = data[at]
    if value < 128:  # nearly always
        return value, at + 1
    value, shift = value & 127, 7
    while (byte := data[at := at + 1]) > 127:
        value |= (byte & 127) << shift
        shift += 7
        if shift > 63:
            raise ValueError("a number of it is too large")
    return value | byte << shift, at + 1
