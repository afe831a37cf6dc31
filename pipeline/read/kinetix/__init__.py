"""Trajectories as the reference has them on disk: a zarr v2 group of arrays of records."""
