"""A split as training code reads it: trajectories batch first, shuffled, parted, prefetched."""
