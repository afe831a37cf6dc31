"""What is on the disk: manifests, shards, checkpoints, and the rules of writing them."""
