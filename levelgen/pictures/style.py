"""The style of pictures for people: colours, and lengths in metres."""

from levelproof.levelgen.level import Role

Colour = tuple[int, int, int]

BORDER = 0.08  # m, visible part of the walls and the ceiling
HEADER, FOOTER = 0.36, 0.30  # m, above and below the world
EDGE = 0.022  # m, width of the line around a shape
PIXELS = 480  # default width of a picture
SHADE = 0.62  # times a body's colour, for its edge
HATCHING = "hatching"
HATCH = (  # diagonal lines over a body, as dark as its edge
    f'<linearGradient id="{HATCHING}" gradientUnits="userSpaceOnUse" x2="0.05" y2="-0.05" spreadMethod="repeat">'
    f'<stop stop-opacity="0"/><stop offset="0.15" stop-opacity="{1 - SHADE:.2f}"/>'
    f'<stop offset="0.25" stop-opacity="{1 - SHADE:.2f}"/><stop offset="0.4" stop-opacity="0"/></linearGradient>'
)

SKY: Colour = (247, 247, 243)
GRID: Colour = (234, 235, 230)
INK: Colour = (38, 44, 52)
PAPER: Colour = (255, 255, 255)
MUTED: Colour = (128, 135, 144)
FIXED_PLAIN: Colour = (98, 105, 115)
LIGHT: dict[str, Colour] = {"sky": SKY, "grid": GRID, "ink": INK, "paper": PAPER, "muted": (104, 111, 121)}  # for pages
DARK: dict[str, Colour] = {  # for pages in dark mode; roles and bindings keep their colours
    "sky": (30, 33, 39),
    "grid": (42, 46, 53),
    "ink": (226, 229, 233),
    "paper": (19, 21, 25),
    "muted": (150, 157, 166),
}
ROLE_COLOUR: dict[Role, Colour] = {
    Role.PLAIN: (168, 175, 184),
    Role.GREEN: (62, 176, 92),
    Role.BLUE: (58, 124, 220),
    Role.RED: (224, 78, 66),
}
BINDING_COLOUR: tuple[Colour, ...] = (  # by entry of the action: four motors, two thrusters
    (245, 184, 22),
    (206, 66, 196),
    (26, 184, 186),
    (245, 124, 40),
    (126, 87, 226),
    (240, 96, 140),
)
FLAMES: tuple[tuple[float, Colour], ...] = ((1.0, (245, 124, 40)), (0.6, (255, 214, 92)))  # length, colour
FONTS = "Aileron, Helvetica, Arial, sans-serif"
CAPTION_SIZE, KEY_SIZE = 0.155, 0.14  # m, font sizes
