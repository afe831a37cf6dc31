"""A split as a site of plain files: what is written, and the pages that read it (`site/`)."""
