"""The player: in a browser, control a level by hand, edit it, and watch an expert train."""
