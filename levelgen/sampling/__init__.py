"""Random levels: bodies proposed one by one from a distribution; of each, the proposal that overlaps least is kept."""
