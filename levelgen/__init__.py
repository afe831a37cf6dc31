"""What a level is: its sampler, its identity, its files, and the task that an agent plays in it."""

if __name__ != "levelproof.levelgen":
    raise ImportError(f"import levelproof.levelgen, not {__name__}: no module is loaded under two names")
