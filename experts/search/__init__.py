"""Search for a success without a policy, by Go-Explore over exact states (Ecoffet et al. 2021, arXiv:2004.12919), then
by variations of whole trajectories.

A level's archive keeps one state per cell of its world's features. Lanes return to archived states, play at random
from there, and archive states that are new or reached sooner (`explore`). If that does not reach the goal, the
trajectories that came nearest to it are varied (`vary`). Imports nothing of experts' training.
"""
