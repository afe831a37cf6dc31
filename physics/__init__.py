"""How bodies move: a lane-parallel 2D rigid-body engine that knows no goals."""

if __name__ != "levelproof.physics":
    raise ImportError(f"import levelproof.physics, not {__name__}: no module is loaded under two names")
