"""A worker's slots and the queue before them: levels in, results out."""
