"""Random levels: a distribution's draws, proposed body by body and kept where nothing overlaps."""
