"""Solving levels: a search, PPO experts of single levels, witnesses as proof, and policies for all levels."""

if __name__ != "levelproof.experts":
    raise ImportError(f"import levelproof.experts, not {__name__}: no module is loaded under two names")
