"""What is seen of a state: features side by side, a set of entities, or pixels."""
