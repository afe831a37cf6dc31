"""Whether a split is what its manifest says, byte by byte."""
