"""Both engines and both trainers in turns, on the same levels: env steps a second."""
