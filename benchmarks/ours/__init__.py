"""Our side of benchmarks, as the reference's side is: processes of their own."""
