"""What to make: Hydra yaml over typed frozen dataclasses. Hydra's dictionaries end at this package's edge."""
