"""Reading of splits, of level files, and of the reference's folders."""
