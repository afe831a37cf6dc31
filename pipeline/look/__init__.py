"""Inspection of splits: counts, rows, pictures."""
