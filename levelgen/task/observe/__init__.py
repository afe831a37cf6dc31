"""Observations of a state: a flat vector of features, a set of entities, or pixels."""
