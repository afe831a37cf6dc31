"""Trajectories as Minari has them on disk: an HDF5 file with a group for each episode."""
