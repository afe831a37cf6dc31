"""Numbers as people type them: 64k, 1M, 11.5M, 10min."""

import re
from decimal import Decimal

from levelproof.configs.errors import ConfigError

SCALES = {"": 1, "k": 1_000, "M": 1_000_000, "B": 1_000_000_000}
PATTERN = re.compile(r"([0-9]+(?:\.[0-9]+)?)([kMB]?)")
SECONDS = {"s": 1, "min": 60, "h": 3600}
DURATION = re.compile(r"([0-9]{1,6}(?:\.[0-9]+)?)(s|min|h)")
MAX_COUNT = 10**15  # beyond any budget or number of levels that could finish; catches typing errors


def parse_duration(text: str, what: str) -> float:
    """Parse a duration into seconds: `parse_duration("10min", "checkpoint") == 600`.

    Raises:
        ConfigError: `text` is not a positive number with a unit; `what` names the setting.
    """
    match = DURATION.fullmatch(text)
    if not match or not float(match[1]):
        raise ConfigError(f"{what} is {text!r}: write a number and its unit, such as 30s, 10min or 2h.")
    return float(match[1]) * SECONDS[match[2]]


def parse_count(text: str | int, what: str) -> int:
    """Parse a count exactly: `parse_count("11.5M", "levels") == 11_500_000`.

    Raises:
        ConfigError: `text` is not a positive whole number, or is too large; `what` names the setting.
    """
    match = PATTERN.fullmatch(str(text))
    if not match:
        raise ConfigError(f"{what} is {text!r}: write a whole number such as 500, 64k, 1M or 11.5M.")
    number = Decimal(match[1]) * SCALES[match[2]]
    if number != number.to_integral_value():
        raise ConfigError(f"{what} is {text!r}, which is not a whole number: use fewer decimals.")
    if not 0 < number <= MAX_COUNT:
        raise ConfigError(f"{what} is {text!r}: it must be at least 1 and at most {MAX_COUNT:,}.")
    return int(number)
