"""The colours of pictures as CSS custom properties, for pages that draw levels themselves."""

from levelproof.levelgen.pictures import style


def palette_css() -> str:
    """Return a style sheet that defines every colour, with a light and a dark variant."""
    both = {
        **{role.name.lower(): colour for role, colour in style.ROLE_COLOUR.items()},
        **{f"binding-{entry}": colour for entry, colour in enumerate(style.BINDING_COLOUR)},
        **{f"flame-{tongue}": colour for tongue, (_, colour) in enumerate(style.FLAMES)},
    }
    dark = f"@media (prefers-color-scheme: dark) {{\n{_rule(style.DARK)}}}\n"
    return f"{_rule(both | style.LIGHT | {'fixed': style.FIXED_PLAIN})}{dark}"


def _rule(colours: dict[str, style.Colour]) -> str:
    lines = [f"  --{name}: rgb{colour};\n" for name, colour in colours.items()]
    return f":root {{\n{''.join(lines)}}}\n"
