"""Tables on standard output."""

from rich.console import Console
from rich.table import Table

WIDE = 10_000  # characters; of files and pipes, where a table takes only what it needs


def console_for_tables() -> Console:
    """Return a console on standard output that prints text as it is, and cuts no cell off in a file or a pipe."""
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console.width = WIDE
    return console


def folded(table: Table) -> Table:
    """Let cells that are too long for a terminal continue on the next line; return the table."""
    for column in table.columns:
        column.overflow, column.no_wrap = "fold", False
    return table
