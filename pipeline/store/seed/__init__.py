"""Seed files: splits as one table, whose records are simulated from level ids and actions when they are read."""
