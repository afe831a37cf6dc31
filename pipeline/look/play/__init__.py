"""A person takes the controls: the server behind `levelproof play` and its page."""
