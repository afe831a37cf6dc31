"""Splits read back: checked, and given to other programs."""
