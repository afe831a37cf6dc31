"""The game played in a level: actions, rules, what is seen of it, and the environment for other people's code."""
