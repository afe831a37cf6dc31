"""Search: a success without a policy, by Go-Explore over exact states (Ecoffet et al. 2021, arXiv:2004.12919), then by
variations of whole trajectories.

A level's archive keeps one state for each cell of what matters in its world. Lanes return to states of the archive,
play at random from there, and put into the archive what is new or reached sooner (`explore`). Where that reaches no
goal, the trajectories that came nearest to it are varied (`vary`). Knows nothing of experts.
"""
