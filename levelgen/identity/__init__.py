"""What a level is called and when two are the same: ids and keys, content hash, signature."""
