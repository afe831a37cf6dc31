"""Reading of splits, level files, policies, agents, and the reference's folders."""
