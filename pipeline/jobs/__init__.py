"""Jobs that make splits: work units, who does them, and what is said meanwhile."""
