"""Where data goes: work units, shards, manifest fragments, Ray workers, the reader and the command line."""
