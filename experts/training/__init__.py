"""One PPO expert a level: rollouts, updates, evaluations and stopping, many slots side by side."""
