"""One policy for all levels, trained by reinforcement learning: rollouts, updates, and which levels come next."""
