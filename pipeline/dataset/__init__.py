"""The reader: batches of levels and records for training code."""
