"""What is known of a level when the search and its expert are done: evaluation, portability, label."""
