"""One policy for all levels: reinforcement, curricula, and teachers that label the states it visits."""
