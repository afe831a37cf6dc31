"""What an expert can be: networks from what it sees of a state to logits of its actions and an expected return."""
