"""Untrusted fragments and seed files: nothing is decompressed before its size is known.

The reader checks the footer's length, the columns, the numbers of rows and row groups, and the headers of the pages
that it reads. It parses these itself: given a false footer, some Arrow calls crash the process. Strings are read as
dictionaries, so that a short file cannot repeat a long string a million times, and are expanded only if their total is
small; strings without a dictionary are as long as their pages.
"""

import errno
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.checksums import TAIL
from levelproof.pipeline.store.columns import COLUMNS, OWN, REPETITIVE, schema_of
from levelproof.pipeline.store.remote import bytes_of
from levelproof.pipeline.store.thrift import PLAIN, Column, footer_in, pages_in
from levelproof.pipeline.urls import is_remote

MAX_FOOTER = 2**24  # bytes; most of them are digests
MAX_ROWS, MAX_GROUPS = 2**20, 2**9  # of a fragment; a sealed one has 100,000 rows, in groups of 16,384
MAX_FIXED = 2**26  # bytes in memory, per read
A_VALUE = 16  # bytes that a value takes besides those of its page
UNSEEN = "content_hash"  # only compared, never printed, so its characters are not checked
ARROW_SCHEMA = b"ARROW:schema"  # key of metadata
WRITER = "parquet-cpp-arrow"  # from files of other writers, Arrow may read more than the footer says
# What reading untrusted bytes can raise
DAMAGE = (OSError, pa.ArrowException, LookupError, ValueError, TypeError, AttributeError, RuntimeError, MemoryError)
# Errors of opening a file that is missing or of another kind
ABSENT = (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ELOOP)
READ_OPTIONS = {
    "pre_buffer": False,
    "page_checksum_verification": True,
    "thrift_string_size_limit": MAX_FOOTER,
    "thrift_container_size_limit": MAX_GROUPS,
}


class OtherKind(ValueError):
    """The file has the columns of another kind."""


class DataUnread(Failure):
    """Bytes cannot be read now, or not by this program: they may be sound, so no repair may remove them."""


def unread(path: Path, error: BaseException | None) -> DataUnread | None:
    """Return the error of a machine that cannot read `path`; None: the file is missing, or its bytes are damaged."""
    if isinstance(error, DataUnread):
        return error
    if isinstance(error, MemoryError):
        return DataUnread(f"There is too little memory to read {path}: free some, then run the same command again.")
    if not isinstance(error, OSError) or error.errno in (None, *ABSENT):  # Arrow's errors of damage have no number
        return None
    reason = error.strerror or type(error).__name__
    return DataUnread(f"{path} cannot be read ({reason}): fix that, then run the same command again.")


@dataclass(frozen=True, eq=False)
class FileKind:
    """A kind of parquet file, and how large its valid files can be."""

    name: str
    columns: pa.Schema
    repetitive: tuple[str, ...]  # string columns that may be returned as dictionaries
    own: tuple[str, ...]  # columns of bytes or strings without dictionaries; their positions are fixed
    encoding: int  # of the pages of `own`
    max_rows: int
    min_row_bytes: int  # of a file, per row
    max_row: int  # bytes in memory, per row
    max_of: dict[str, int] = field(default_factory=dict)  # additional bytes in memory per row, by column


FRAGMENTS = FileKind(
    "fragment",
    COLUMNS,
    REPETITIVE,
    OWN,
    PLAIN,
    MAX_ROWS,
    min_row_bytes=8,  # content hashes alone take more, however well they are compressed
    max_row=2**12,
    max_of={"learning_curve": 2**17},  # with as many updates as the largest budgets have
)


class Bounded:
    """A parquet file, open for reading the columns of its kind within bounds."""

    def __init__(self, source: pa.NativeFile, kind: FileKind = FRAGMENTS) -> None:
        """Check the footer.

        Raises:
            One of DAMAGE: it is invalid, or larger than that of any file of its kind.
        """
        self._source, self._kind, size = source, kind, source.size()
        source.seek(max(0, size - TAIL))
        length = int.from_bytes(source.read(4), "little")
        if length > min(MAX_FOOTER, size - TAIL):
            raise ValueError(f"its footer is longer than that of any {kind.name}")
        source.seek(size - TAIL - length)
        self.rows, self._groups, made_by = footer_in(source.read(length))
        if not 0 <= self.rows <= min(kind.max_rows, size // kind.min_row_bytes) or len(self._groups) > MAX_GROUPS:
            raise ValueError(f"it has more rows than any {kind.name} of its size")
        if min((group.rows for group in self._groups), default=0) < 0 or sum(g.rows for g in self._groups) != self.rows:
            raise ValueError("the rows of its groups do not add up")
        if not made_by.startswith(WRITER):
            raise ValueError("it was written by another library")
        own = [i for i, leaf in enumerate(_expected(kind).leaves) if _column_of(leaf) in kind.own]
        self._are_plain = not any(group.columns[i].has_dictionary for group in self._groups for i in own)
        self._file = _open(source, _expected(kind, self._are_plain).texts)
        stored: dict[bytes, bytes] = self._file.metadata.metadata or {}  # also what was added after the schema
        self.metadata = {key: value for key, value in stored.items() if key != ARROW_SCHEMA}

    def read(
        self,
        names: Sequence[str],
        level_ids: np.ndarray | None = None,
        compact: bool = False,
        at: np.ndarray | None = None,
    ) -> pa.Table:
        """Read columns, of all rows or, with `level_ids` or `at`, at least of the rows of these levels or positions.

        Args:
            names: columns to read.
            level_ids: levels whose row groups to read.
            compact: return repetitive columns as dictionaries.
            at: positions whose row groups to read, if they are known.

        Raises:
            One of DAMAGE: the file is damaged, or would take too much memory.
        """
        known = _expected(self._kind, self._are_plain)
        if not self._file.schema.equals(known.schema) or not self._file.schema_arrow.equals(known.as_read):
            raise ValueError(f"its columns are not those of a {self._kind.name}")
        groups = range(len(self._groups))
        if level_ids is not None and groups[1:]:
            at = np.flatnonzero(np.isin(self._read(known, groups, ["level_id"]).column(0).to_numpy(), level_ids))
        if at is not None:
            ends = np.cumsum([group.rows for group in self._groups])
            groups = np.unique(np.searchsorted(ends, at, "right")).tolist()
        table = self._read(known, groups, names)
        wanted = schema_of(names, compact, self._kind.columns, self._kind.repetitive)
        stored = {name: table.column(name) for name in names}
        expanded = [name for name, column in stored.items() if column.type != wanted.field(name).type]
        if any(map(_has_controls, (chunk for name in names if name != UNSEEN for chunk in stored[name].chunks))):
            raise ValueError("its strings contain control characters")
        self._require_room(sum(_expanded_bytes(chunk) for name in expanded for chunk in stored[name].chunks), names)
        columns = {name: column.cast(wanted.field(name).type) for name, column in stored.items()}
        return pa.table(columns, schema=wanted.with_metadata(self.metadata))

    def _read(self, known: "_Expected", groups: Sequence[int], names: Sequence[str]) -> pa.Table:
        chosen = [(i, leaf) for i, leaf in enumerate(known.leaves) if _column_of(leaf) in names]
        wanted = [self._groups[group] for group in groups]
        columns = [
            (group.columns[i], group.rows, leaf, leaf.path in known.plain) for group in wanted for i, leaf in chosen
        ]
        self._require_room(sum(max(0, column.length) for column, *_ in columns), names)
        self._require_room(sum(self._room(*each) for each in columns), names)
        # One by one: Arrow sometimes fails to read lists of strings as dictionaries from several groups at once
        parts = [self._file.read_row_groups([group], list(names), use_threads=False) for group in groups]
        table = pa.concat_tables(parts or [self._file.read_row_groups([], list(names))])
        table.validate(full=True)  # dictionary indices, offsets and UTF-8, on which later code relies
        return table

    def _room(self, column: Column, rows: int, leaf: pq.ColumnSchema, is_plain: bool) -> int:
        """Return the bytes that a group's column takes in memory, without the strings in its dictionary."""
        if column.first < 0 or not 0 <= column.length <= self._source.size() - column.first:
            raise ValueError("a column lies outside of the file")
        self._source.seek(column.first)
        chunk = self._source.read(column.length)
        pages = list(pages_in(chunk)) if column.values else []  # without values, Arrow writes no offset, reads no page
        values = sum(page.values for page in pages if not page.is_dictionary)
        if values != column.values or (values != rows and leaf.max_repetition_level == 0):
            raise ValueError("a column does not have one value per row")
        if is_plain and any(page.is_dictionary or page.encoding != self._kind.encoding for page in pages):
            raise ValueError("a column's strings are not encoded as this program writes them")
        return sum(page.bytes + A_VALUE * page.values for page in pages)

    def _require_room(self, wanted: int, names: Sequence[str]) -> None:
        """Raise ValueError if `wanted` bytes are more than these columns take in any fragment."""
        kind = self._kind
        most = kind.max_row + sum(most for name, most in kind.max_of.items() if name in names)
        if wanted > MAX_FIXED + most * self.rows:
            raise ValueError(f"its rows would take more memory than those of any {kind.name}")


@contextmanager
def bounded(path: Path, kind: FileKind = FRAGMENTS) -> Iterator[Bounded]:
    """Open a file of a kind, local or remote.

    Raises: as `Bounded`; FileNotFoundError: it is missing.
    """
    with pa.BufferReader(bytes_of(path)) if is_remote(path) else pa.OSFile(str(path)) as source:
        yield Bounded(source, kind)


def _has_controls(column: pa.Array) -> bool:
    """Whether a string of an array contains characters that control terminals."""
    if pa.types.is_dictionary(column.type) or pa.types.is_string(column.type):
        texts = column.dictionary if pa.types.is_dictionary(column.type) else column
        data = np.frombuffer(texts.buffers()[2] or b" ", np.uint8)
        if data.min(initial=32) >= 32 and data.max(initial=32) < 127:  # the common case, and fast
            return False
        matches = pc.call_function("match_substring_regex", [texts], pc.MatchSubstringOptions(r"\p{Cc}"))
        return matches.true_count > 0
    nested = pa.types.is_list(column.type) or pa.types.is_struct(column.type)
    return nested and any(map(_has_controls, _inside(column)))


def _expanded_bytes(column: pa.Array) -> int:
    """Sum the bytes of all strings in an array, repetitions included."""
    if pa.types.is_dictionary(column.type):
        lengths = pc.call_function("binary_length", [column.dictionary]).take(column.indices)
        return pc.call_function("sum", [lengths]).as_py() or 0
    nested = pa.types.is_list(column.type) or pa.types.is_struct(column.type)
    return sum(map(_expanded_bytes, _inside(column))) if nested else 0


def _inside(column: pa.Array) -> list[pa.Array]:
    """Return the values of a list array, or the fields of a struct array."""
    return [column.flatten()] if pa.types.is_list(column.type) else column.flatten()


class _Expected(NamedTuple):
    """Schema of a valid file of a kind."""

    schema: pq.ParquetSchema
    as_read: pa.Schema  # with strings as dictionaries
    leaves: list[pq.ColumnSchema]
    texts: list[str]  # paths of string leaves that are read as dictionaries
    plain: list[str]  # paths of string leaves without dictionaries


@cache
def _expected(kind: FileKind, own_are_plain: bool = False) -> _Expected:
    """Return the schema of a file of this kind; with `own_are_plain`, `kind.own` have no dictionaries."""
    sink = pa.BufferOutputStream()
    pq.write_table(kind.columns.empty_table(), sink)
    schema = pq.ParquetFile(pa.BufferReader(sink.getvalue())).schema
    leaves = [schema.column(i) for i in range(len(schema))]
    plain = [leaf.path for leaf in leaves if own_are_plain and _column_of(leaf) in kind.own]
    texts = [leaf.path for leaf in leaves if leaf.physical_type == "BYTE_ARRAY" and leaf.path not in plain]
    return _Expected(schema, _open(pa.BufferReader(sink.getvalue()), texts).schema_arrow, leaves, texts, plain)


def _column_of(leaf: pq.ColumnSchema) -> str:
    return leaf.path.partition(".")[0]


def with_dictionaries() -> list[str]:
    """Return the paths of a fragment's leaves that are written with dictionaries."""
    return [leaf.path for leaf in _expected(FRAGMENTS).leaves if _column_of(leaf) not in FRAGMENTS.own]


def _open(source: pa.NativeFile, texts: list[str]) -> pq.ParquetFile:
    try:
        return pq.ParquetFile(source, read_dictionary=texts, **READ_OPTIONS)
    except KeyError as error:
        raise OtherKind(f"it has no column {error.args[0]!r}") from None
