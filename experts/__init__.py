"""Who solves it: one PPO specialist per level, many side by side, and the witnesses that prove it."""
