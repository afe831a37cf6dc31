"""How large a fragment may be: looked at in its footer before anything is unpacked."""

import pyarrow.parquet as pq

CAREFULLY = {"page_checksum_verification": True, "thrift_string_size_limit": 2**26}
MOST_ROWS, MOST_GROUPS = 10_000_000, 100_000  # of a fragment
MOST_FIXED, MOST_A_ROW = 2**26, 2**14  # bytes in memory of a fragment, and of each of its rows: a hundred times theirs


def require_modest(about: pq.FileMetaData) -> None:
    """Raises ValueError where a small file would become large: pages of nothing are packed ten thousandfold."""
    groups = [about.row_group(i) for i in range(about.num_row_groups)]
    if about.num_rows > MOST_ROWS or len(groups) > MOST_GROUPS:
        raise ValueError("it has more rows than any fragment")
    if sum(group.total_byte_size for group in groups) > MOST_FIXED + MOST_A_ROW * about.num_rows:
        raise ValueError("its rows would take more memory than those of any fragment")
