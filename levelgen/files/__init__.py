"""Levels as the reference has them: its arrays and its level files."""
