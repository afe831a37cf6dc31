"""What measures: this program by itself and beside the reference. Not installed; `python -m benchmarks --help`."""
