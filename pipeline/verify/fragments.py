"""A split's fragments and their rows, read in groups that are examined together."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa

from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.bounds import DAMAGE, DataUnread, bounded, unread
from levelproof.pipeline.store.checksums import has_own
from levelproof.pipeline.store.fragment import Fragment, read_fragment
from levelproof.pipeline.store.remote import is_listed, stale_index
from levelproof.pipeline.verify.evidence import COLUMNS
from levelproof.pipeline.verify.findings import Findings

Part = tuple[Fragment, pa.Table]  # a fragment and its rows


@dataclass
class FragmentGroup:
    """Fragments that are examined together."""

    files: list[tuple[Path, int]] = field(default_factory=list)  # as in `layout.fragment_files`
    ids: list[np.ndarray] = field(default_factory=list)  # of the levels of sound fragments
    named: set[str] = field(default_factory=set)  # shards and experts that sound fragments name
    findings: Findings = field(default_factory=Findings)


def grouped(files: Sequence[tuple[Path, int]], least: int) -> Iterator[tuple[FragmentGroup, list[Part]]]:
    """Yield fragments in groups of `least` rows or more, damaged ones with their reasons, and the sound ones' rows.

    Raises:
        DataUnread: a fragment cannot be read, so that nothing is known about it.
    """
    group, parts = FragmentGroup(), list[Part]()
    for file in files:
        group.files.append(file)
        try:
            part = _part(file[0])
            parts += [part] if part[0].rows else []  # empty ones are fences
        except DataUnread:
            raise
        except Failure as failure:
            group.findings.fragments[file[0]] = str(failure)
        if sum(rows.num_rows for _, rows in parts) >= least or file == files[-1]:
            yield group, parts
            group, parts = FragmentGroup(), []


def _part(path: Path) -> Part:
    """Read a fragment, after its checksum: parsing a damaged one can crash the process.

    Raises:
        DataUnread: this machine cannot read it, or it has another version.
        Failure: it is damaged or missing.
    """
    try:
        if not has_own(path):
            raise Failure(f"The fragment {path} is not what was committed: its bytes have changed.")
        fragment, rows = read_fragment(path, ["level_id", *COLUMNS])
    except (OSError, MemoryError) as error:
        if isinstance(error, FileNotFoundError) and not is_listed(path):
            raise DataUnread(stale_index(path)) from None
        if machines := unread(path, error):
            raise machines from None
        raise Failure(f"The fragment {path} is missing or damaged ({type(error).__name__}).") from None
    return fragment, rows


def rows_in(path: Path) -> int:
    """Return how many rows a fragment's footer claims; 0 if it cannot be read."""
    with suppress(*DAMAGE), bounded(path) as file:
        return file.rows
    return 0
