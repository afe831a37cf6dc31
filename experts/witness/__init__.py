"""Witnesses prove that a level can be solved: the actions of a success, replayed from the initial state."""
