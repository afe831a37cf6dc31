"""The benchmark `solved`: levels solved by our defaults, by variants of them, and by the reference's PPO."""
