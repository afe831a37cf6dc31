"""Fragments whose footers and pages lie: each is refused in one sentence, in little memory, without a crash."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from levelproof.experts.labels import Label
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.columns import COLUMNS, OWN
from levelproof.pipeline.store.fragment import read_fragment
from levelproof.pipeline.store.manifest import fragment_paths, read_manifest
from levelproof.pipeline.store.thrift import footer_in, pages_in
from tests.pace import patience
from tests.pipeline.command import ROOT
from tests.pipeline.made import made_split

MOST = 100 * 2**20  # bytes of memory that reading all hostile files may take beyond those of a good one
PEAK = """
import json, resource, sys
from pathlib import Path
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.manifest import read_fragment
peak = lambda: 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
good, *others = map(Path, sys.argv[1:])
read_fragment(good)
before, reasons = peak(), []
for path in others:
    try:
        read_fragment(path)
        reasons.append("")
    except Failure as failure:
        reasons.append(str(failure.__cause__))
print(json.dumps([peak() - before, reasons]))
"""


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    (path,) = fragment_paths(made_split(tmp_path_factory.mktemp("good"), [[Label.SOLVED, Label.UNSOLVED]]))
    return path


def with_column(good: Path, name: str, values: pa.Array, use_dictionary: bool = True, **how: Any) -> bytes:
    """Return the fragment's bytes with one column replaced, repeating its first row to match."""
    table = pq.read_table(good)
    rows = table.take(np.zeros(len(values), int))
    at = COLUMNS.names.index(name)
    sink = BytesIO()
    rows = rows.set_column(at, COLUMNS.field(at), values)
    pq.write_table(rows, sink, compression="zstd", write_page_checksum=True, use_dictionary=use_dictionary, **how)
    return sink.getvalue()


def footer_of(data: bytes) -> slice:
    return slice(len(data) - 8 - int.from_bytes(data[-8:-4], "little"), len(data) - 8)


def varint(number: int, length: int = 0) -> bytes:
    """Encode a number as a zigzag varint of at least `length` bytes."""
    number, encoded = number << 1, b""
    while number > 127 or len(encoded) < length - 1:
        encoded += bytes([number & 127 | 128])
        number >>= 7
    return encoded + bytes([number])


def with_other_numbers(data: bytes, change: Callable[[int], int], where: slice, numbers: set[int]) -> bytes:
    """Change all occurrences of numbers that take at least three bytes, keeping their lengths."""
    part = data[where]
    for number in numbers:
        if len(encoded := varint(number)) > 2:
            part = part.replace(encoded, varint(change(number), len(encoded)))
    assert part != data[where]
    return data[: where.start] + part + data[where.stop :]


def long_texts(good: Path) -> bytes:
    """A dictionary of one string of 1.2 MB, to which 100 rows refer."""
    text = pa.chunked_array([pa.array(["x" * 1_200_000]).take(np.zeros(10, int))] * 10)
    return with_column(good, "label_reason", text)


def long_pages(good: Path) -> bytes:
    """120 MB of one byte, with wrong sizes in the footer."""
    text = pa.array([f"{i:03d}" + "x" * 1_200_000 for i in range(10)] * 10)
    data = with_column(good, "label_reason", text, use_dictionary=False)
    about = pq.read_metadata(BytesIO(data)).row_group(0)
    sizes = {about.total_byte_size, about.column(COLUMNS.names.index("label_reason")).total_uncompressed_size}
    return with_other_numbers(data, lambda _: 7, footer_of(data), {size for size in sizes if size > 10**6})


def long_hashes(good: Path) -> bytes:
    """120 MB of hashes without a dictionary."""
    text = pa.array([f"{i:03d}" + "x" * 1_200_000 for i in range(10)] * 10)
    return with_column(good, "content_hash", text, use_dictionary=False)


def shortened_hashes(good: Path) -> bytes:
    """120 MB of hashes, delta-encoded."""
    text = pa.array(["x" * 1_200_000] * 100)
    return with_column(good, "content_hash", text, False, column_encoding={"content_hash": "DELTA_BYTE_ARRAY"})


def long_lists(good: Path) -> bytes:
    """A learning curve of millions of zeros, whose pages take a few bytes."""
    curve = pa.ListArray.from_arrays([0, 6_000_000], pa.array(np.zeros(6_000_000, np.float32)))
    return with_column(good, "learning_curve", curve)


def many_rows(good: Path) -> bytes:
    """One row repeated many times."""
    return with_column(good, "label", pa.array(["solved"]).take(np.zeros(100_000, int)))


def other_values(good: Path) -> bytes:
    """A footer that counts too few values."""
    hashes = [f"{number:064x}" for number in np.random.default_rng(0).integers(0, 2**62, 20_000)]
    data = with_column(good, "content_hash", pa.array(hashes))
    return with_other_numbers(data, lambda n: n - 1, footer_of(data), {20_000})


HOSTILE = {
    long_texts: "its rows would take more memory than those of any fragment",
    long_pages: "its rows would take more memory than those of any fragment",
    long_hashes: "its rows would take more memory than those of any fragment",
    shortened_hashes: "a column's strings are not encoded as this program writes them",
    long_lists: "its rows would take more memory than those of any fragment",
    many_rows: "it has more rows than any fragment of its size",
    other_values: "a column does not have one value per row",
}


def test_write_fragment_writes_unique_strings_without_dictionaries(good: Path) -> None:
    group = pq.read_metadata(good).row_group(0)
    columns = [group.column(i) for i in range(group.num_columns)]
    texts = [column for column in columns if column.physical_type == "BYTE_ARRAY"]
    without = [column for column in texts if not column.has_dictionary_page]
    assert {column.path_in_schema.partition(".")[0] for column in without} == {*OWN}


@pytest.mark.slow
def test_read_fragment_refuses_bombs_before_decompressing_them(good: Path, tmp_path: Path) -> None:
    paths = []
    for number, make in enumerate(HOSTILE):
        paths.append(tmp_path / str(number) / good.name)
        paths[-1].parent.mkdir()
        paths[-1].write_bytes(make(good))
        assert paths[-1].stat().st_size < 5_000_000
    done = subprocess.run(
        [sys.executable, "-c", PEAK, str(good), *map(str, paths)],
        env={"PYTHONPATH": str(ROOT), "PATH": ""},
        capture_output=True,
        text=True,
        check=True,
        timeout=patience(1800),
    )
    grown, reasons = json.loads(done.stdout)
    assert reasons == [*HOSTILE.values()]
    assert grown < MOST


def test_read_fragment_survives_lying_size_statistics(good: Path) -> None:
    """With too many numbers in size statistics, pyarrow's `column` raises a C++ exception that ends the process."""
    data = good.read_bytes()
    start, end = footer_of(data).start, footer_of(data).stop
    lists = [match.end() for match in re.finditer(rb"[\x19\x29\x39]\x26", data[start:end])]  # of two numbers
    assert len(lists) > 3
    for at in lists:
        footer = data[start : start + at - 1] + b"\x36\x02" + data[start + at : end]
        good.write_bytes(data[:start] + footer + len(footer).to_bytes(4, "little") + b"PAR1")
        with suppress(Failure):
            read_fragment(good)
            read_manifest(good.parents[1], ["label"], [1])
    good.write_bytes(data)


def test_footer_in_and_pages_in_agree_with_arrow(good: Path) -> None:
    data = good.read_bytes()
    footer, about = footer_in(data[footer_of(data)]), pq.read_metadata(good)
    assert (footer.rows, footer.made_by) == (about.num_rows, about.created_by)
    for group, columns in enumerate(footer.groups):
        for i, column in enumerate(columns.columns):
            expected = about.row_group(group).column(i)
            assert column.values == expected.num_values
            assert column.length == expected.total_compressed_size
            assert column.first == min(filter(None, (expected.data_page_offset, expected.dictionary_page_offset)))
            pages = list(pages_in(data[column.first : column.first + column.length]))
            assert sum(page.values for page in pages if not page.is_dictionary) == expected.num_values
            assert sum(page.bytes for page in pages) <= expected.total_uncompressed_size


def test_read_fragment_accepts_no_rows(good: Path, tmp_path: Path) -> None:
    empty = pq.read_table(good).slice(0, 0)
    pq.write_table(empty, tmp_path / good.name, compression="zstd", write_page_checksum=True)
    assert read_fragment(tmp_path / good.name)[1].num_rows == 0
