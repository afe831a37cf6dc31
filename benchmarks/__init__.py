"""Benchmarks of this program, alone and beside the reference; not installed. See `python -m benchmarks --help`."""
