"""Our side of benchmarks, which runs in its own processes, as the reference's side does."""
