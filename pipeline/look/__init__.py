"""Splits looked at: counts, rows, pictures."""
