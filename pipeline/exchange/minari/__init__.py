"""Episodes of a split as a Minari dataset."""
