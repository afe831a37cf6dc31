"""Training of policies on splits."""
