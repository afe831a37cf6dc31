"""The player: a person takes the controls in a browser, edits the level, and watches an expert train."""
