"""The game played in a level: actions, rules, observations, and the environments for users' code."""
