"""What a level is: its sampler, its identity, its files, and the task that an agent has in it."""
