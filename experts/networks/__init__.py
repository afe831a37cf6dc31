"""Networks of experts and of policies for all levels, and saved policies."""
