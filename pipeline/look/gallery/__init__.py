"""A split as a static site: its data files, and the pages that read them (`site/`)."""
