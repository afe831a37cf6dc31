"""Verification of splits: every byte, level, label and witness."""
