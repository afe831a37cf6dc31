"""Jobs that make splits: work units, the executors that run them, and their progress reports."""
