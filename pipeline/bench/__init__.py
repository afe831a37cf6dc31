"""`levelproof bench`: this program beside the reference, on the same machine, levels and actions, in turns."""

from pipeline.bench.command import main

__all__ = ["main"]
