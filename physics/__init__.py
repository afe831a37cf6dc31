"""How bodies move: a lane-parallel 2D rigid-body engine that knows no goals."""
