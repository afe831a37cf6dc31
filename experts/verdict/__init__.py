"""Judging a level after search and training: evaluation, portability, label."""
