"""Making, storing and reading datasets: work units, Ray workers, shards, manifests, the reader, the command line."""

if __name__ != "levelproof.pipeline":
    raise ImportError(f"import levelproof.pipeline, not {__name__}: no module is loaded under two names")
