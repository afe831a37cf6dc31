"""Fragments that nobody vouches for: nothing is unpacked before it is known how large it becomes.

What is looked at: how long the footer is, that the columns are those of a fragment, how many rows and groups of rows
there are, and the headers of the pages that are read. Nothing of these is asked of Arrow: where a footer lies, some of
its answers end the process. Texts come as dictionaries, so that a short file cannot name a long one a million times,
and become whole texts where all of them together are small; those of which a file has none are as long as its pages.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from levelproof.pipeline.store.checksums import TAIL
from levelproof.pipeline.store.columns import COLUMNS, OWN, schema_of
from levelproof.pipeline.store.remote import bytes_of, is_remote
from levelproof.pipeline.store.thrift import PLAIN, Column, footer_in, pages_in

MAX_FOOTER = 2**24  # bytes; most of them are digests
MAX_ROWS, MAX_GROUPS = 2**20, 2**9  # of a fragment; a sealed one has 100,000 rows, in groups of 16,384
FEWEST_BYTES = 8  # of a file for each row: content hashes alone take more, however they are packed
# Bytes in memory: of what is read at once, for each of its rows, and for a learning curve, of as many updates as the
# largest budgets have
MAX_FIXED, MAX_A_ROW, MAX_A_CURVE = 2**26, 2**12, 2**17
A_VALUE = 16  # bytes that a value takes besides those of its page
CURVE = "learning_curve"
UNSEEN = "content_hash"  # is compared and never shown
BY = "parquet-cpp-arrow"  # who wrote it: of others' files Arrow reads more than they say
# What reading bytes that nobody vouches for can raise
DAMAGE = (OSError, pa.ArrowException, LookupError, ValueError, TypeError, AttributeError, RuntimeError, MemoryError)
CAREFULLY = {
    "pre_buffer": False,
    "page_checksum_verification": True,
    "thrift_string_size_limit": MAX_FOOTER,
    "thrift_container_size_limit": MAX_GROUPS,
}


class Bounded:
    """A parquet file, open for reading; what it is read for are the columns of a fragment."""

    def __init__(self, source: pa.NativeFile) -> None:
        """Look at its footer.

        Raises:
            One of DAMAGE: it is none, or larger than any fragment.
        """
        self._source, size = source, source.size()
        source.seek(max(0, size - TAIL))
        length = int.from_bytes(source.read(4), "little")
        if length > min(MAX_FOOTER, size - TAIL):
            raise ValueError("its footer is longer than that of any fragment")
        source.seek(size - TAIL - length)
        self.rows, self._groups, made_by = footer_in(source.read(length))
        if not 0 <= self.rows <= min(MAX_ROWS, size // FEWEST_BYTES) or len(self._groups) > MAX_GROUPS:
            raise ValueError("it has more rows than any fragment of its size")
        if min((group.rows for group in self._groups), default=0) < 0 or sum(g.rows for g in self._groups) != self.rows:
            raise ValueError("its groups have other numbers of rows than all of it")
        if not made_by.startswith(BY):
            raise ValueError("it was written by another library")
        # Where they stand is the same in every version
        own = [i for i, leaf in enumerate(_known(tuple(COLUMNS.names)).leaves) if _column_of(leaf) in OWN]
        self._are_plain = not any(group.columns[i].has_dictionary for group in self._groups for i in own)
        self._file = _open(source, _known(tuple(COLUMNS.names), self._are_plain).texts)
        self.metadata: dict[bytes, bytes] = self._file.schema_arrow.metadata or {}

    def read(
        self,
        names: Sequence[str],
        all_names: Sequence[str],
        level_ids: np.ndarray | None = None,
        compact: bool = False,
    ) -> pa.Table:
        """These columns of the ones that it has to have; with `level_ids`, at least the rows of these levels.

        Raises:
            One of DAMAGE: it is damaged, or would become too large.
        """
        known = _known(tuple(all_names), self._are_plain)
        if not self._file.schema.equals(known.schema) or not self._file.schema_arrow.equals(known.as_read):
            raise ValueError("it has other columns than a fragment")
        groups = range(len(self._groups))
        if level_ids is not None and groups[1:]:
            there = np.isin(self._read(known, groups, ["level_id"]).column(0).to_numpy(), level_ids)
            ends = np.cumsum([group.rows for group in self._groups])
            groups = np.unique(np.searchsorted(ends, np.flatnonzero(there), "right")).tolist()
        table, wanted = self._read(known, groups, names), schema_of(names, compact)
        given = {name: table.column(name) for name in names}
        whole = [name for name, column in given.items() if column.type != wanted.field(name).type]
        if any(map(_obeyed, (chunk for name in names if name != UNSEEN for chunk in given[name].chunks))):
            raise ValueError("it has text that no terminal should see")
        self._require_room(sum(_expanded(chunk) for name in whole for chunk in given[name].chunks), names)
        columns = {name: column.cast(wanted.field(name).type) for name, column in given.items()}
        return pa.table(columns, schema=wanted.with_metadata(self.metadata))

    def _read(self, known: "_Known", groups: Sequence[int], names: Sequence[str]) -> pa.Table:
        chosen = [(i, leaf) for i, leaf in enumerate(known.leaves) if _column_of(leaf) in names]
        wanted = [self._groups[group] for group in groups]
        columns = [
            (group.columns[i], group.rows, leaf, leaf.path in known.plain) for group in wanted for i, leaf in chosen
        ]
        self._require_room(sum(max(0, column.length) for column, *_ in columns), names)
        self._require_room(sum(self._room(*each) for each in columns), names)
        # One by one: of several, Arrow now and then cannot read lists of texts as dictionaries
        parts = [self._file.read_row_groups([group], list(names), use_threads=False) for group in groups]
        table = pa.concat_tables(parts or [self._file.read_row_groups([], list(names))])
        table.validate(full=True)  # indices into dictionaries, offsets and UTF-8, which others then rely on
        return table

    def _room(self, column: Column, rows: int, leaf: pq.ColumnSchema, is_plain: bool) -> int:
        """Bytes that a column of a group takes in memory, but for texts that stand in its dictionary."""
        if column.first < 0 or not 0 <= column.length <= self._source.size() - column.first:
            raise ValueError("its footer has a column where there is none")
        self._source.seek(column.first)
        chunk = self._source.read(column.length)
        found = list(pages_in(chunk)) if column.values else []  # of none, Arrow writes no place and reads no page
        values = sum(page.values for page in found if not page.is_dictionary)
        if values != column.values or (values != rows and leaf.max_repetition_level == 0):
            raise ValueError("it has other numbers of values than its rows")
        if is_plain and any(page.is_dictionary or page.encoding != PLAIN for page in found):
            raise ValueError("it has texts that are not as they were written")
        return sum(page.bytes + A_VALUE * page.values for page in found)

    def _require_room(self, wanted: int, names: Sequence[str]) -> None:
        """Raises ValueError where so many bytes of these columns are more than fragments have."""
        if wanted > MAX_FIXED + (MAX_A_ROW + MAX_A_CURVE * (CURVE in names)) * self.rows:
            raise ValueError("its rows would take more memory than those of any fragment")


@contextmanager
def bounded(path: Path) -> Iterator[Bounded]:
    """A fragment's file, wherever it is.

    Raises: as `Bounded`; FileNotFoundError: it is gone.
    """
    with pa.BufferReader(bytes_of(path)) if is_remote(path) else pa.OSFile(str(path)) as source:
        yield Bounded(source)


def _obeyed(column: pa.Array) -> bool:
    """Whether a text of an array has characters that control terminals."""
    if pa.types.is_dictionary(column.type) or pa.types.is_string(column.type):
        texts = column.dictionary if pa.types.is_dictionary(column.type) else column
        data = np.frombuffer(texts.buffers()[2] or b" ", np.uint8)
        if data.min(initial=32) >= 32 and data.max(initial=32) < 127:  # nearly always, and soon known
            return False
        found = pc.call_function("match_substring_regex", [texts], pc.MatchSubstringOptions(r"\p{Cc}"))
        return found.true_count > 0
    nested = pa.types.is_list(column.type) or pa.types.is_struct(column.type)
    return nested and any(map(_obeyed, _inside(column)))


def _expanded(column: pa.Array) -> int:
    """Bytes of all texts in an array, each as often as it is named."""
    if pa.types.is_dictionary(column.type):
        lengths = pc.call_function("binary_length", [column.dictionary]).take(column.indices)
        return pc.call_function("sum", [lengths]).as_py() or 0
    nested = pa.types.is_list(column.type) or pa.types.is_struct(column.type)
    return sum(map(_expanded, _inside(column))) if nested else 0


def _inside(column: pa.Array) -> list[pa.Array]:
    """Of a list its values, of a struct its fields."""
    return [column.flatten()] if pa.types.is_list(column.type) else column.flatten()


class _Known(NamedTuple):
    """What a file with some columns says of them."""

    schema: pq.ParquetSchema
    as_read: pa.Schema  # with texts as dictionaries
    leaves: list[pq.ColumnSchema]
    texts: list[str]  # the leaves that are, by their paths
    plain: list[str]  # and those that are texts as they stand


@cache
def _known(names: tuple[str, ...], own_are_plain: bool = False) -> _Known:
    """`own_are_plain`: of OWN it has no dictionaries."""
    sink = pa.BufferOutputStream()
    pq.write_table(schema_of(names).empty_table(), sink)
    schema = pq.ParquetFile(pa.BufferReader(sink.getvalue())).schema
    leaves = [schema.column(i) for i in range(len(schema))]
    plain = [leaf.path for leaf in leaves if own_are_plain and _column_of(leaf) in OWN]
    texts = [leaf.path for leaf in leaves if leaf.physical_type == "BYTE_ARRAY" and leaf.path not in plain]
    return _Known(schema, _open(pa.BufferReader(sink.getvalue()), texts).schema_arrow, leaves, texts, plain)


def _column_of(leaf: pq.ColumnSchema) -> str:
    return leaf.path.partition(".")[0]


def with_dictionaries() -> list[str]:
    """The leaves of a fragment that are written with dictionaries, by their paths."""
    return [leaf.path for leaf in _known(tuple(COLUMNS.names)).leaves if _column_of(leaf) not in OWN]


def _open(source: pa.NativeFile, texts: list[str]) -> pq.ParquetFile:
    return pq.ParquetFile(source, read_dictionary=texts, **CAREFULLY)
