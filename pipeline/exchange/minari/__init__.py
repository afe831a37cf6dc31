"""Export of episodes to a Minari dataset."""
