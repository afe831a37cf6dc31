"""Random levels: bodies are added one by one, each the least overlapping of several random proposals."""
