"""How many levels experts solve: our defaults, variants of them, and the reference's PPO."""
