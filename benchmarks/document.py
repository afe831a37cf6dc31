"""Tables that are made, in documents that are written."""


def between_marks(text: str, mark: str, made: str) -> str:
    """A document with `made` between its lines `<!-- MARK -->` and `<!-- end of MARK -->`."""
    before, begin, rest = text.partition(f"<!-- {mark} -->\n")
    _, end, after = rest.partition(f"<!-- end of {mark} -->\n")
    if not end:
        raise SystemExit(f"The document has no lines <!-- {mark} --> and <!-- end of {mark} -->.")
    return f"{before}{begin}\n{made.strip()}\n\n{end}{after}"
