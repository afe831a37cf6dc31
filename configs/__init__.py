"""Configuration of a job: Hydra yaml over typed frozen dataclasses. Hydra's dictionaries end at this package's edge."""

if __name__ != "levelproof.configs":
    raise ImportError(f"import levelproof.configs, not {__name__}: no module is loaded under two names")
