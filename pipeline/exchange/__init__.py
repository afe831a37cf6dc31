"""Exports of splits: Kinetix, Minari, tables and level files."""
