"""Where data goes: work units, shards, manifest fragments, Ray workers, the reader and the command line."""

if __name__ != "levelproof.pipeline":
    raise ImportError(f"import levelproof.pipeline, not {__name__}: no module is loaded under two names")
