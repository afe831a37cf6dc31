"""Exports of splits: Kinetix, Minari, tables, seed files and level files."""
