"""Data on disk: manifests, shards, checkpoints, and the rules for writing them."""
