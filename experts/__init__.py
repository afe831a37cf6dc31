"""Solving levels: a search, one PPO expert per level, many side by side, and witnesses as proof."""

if __name__ != "levelproof.experts":
    raise ImportError(f"import levelproof.experts, not {__name__}: no module is loaded under two names")
