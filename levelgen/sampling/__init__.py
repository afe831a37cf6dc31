"""Random levels: bodies are added one by one, each the least overlapping of its random proposals (in size s, one)."""
