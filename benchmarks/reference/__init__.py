"""Scripts for the reference's own interpreter, and plain modules that both sides import."""
