"""The reference's trajectories on disk: a zarr v2 group of structured arrays."""
