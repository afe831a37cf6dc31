"""Splits for other programs: Kinetix, Minari, tables and level files."""
