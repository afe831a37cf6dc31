"""Data on disk or in a store: manifests, shards, checkpoints, seed files, and the rules for writing them."""
