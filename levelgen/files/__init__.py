"""Levels in the reference's formats: its arrays and its level files."""
