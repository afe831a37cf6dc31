"""A level's identity: id and random keys, content hash, signature."""
