"""One PPO expert per level: rollouts, updates, evaluations and stopping, many slots side by side."""
