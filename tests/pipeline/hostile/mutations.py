"""Mutations of valid inputs by a seeded generator: accidental damage, and some deliberate attacks."""

import copy
import json
import os
from pathlib import Path
from random import Random
from typing import Any

DEPTH = 100_000
NUMBERS = (
    *(0, 1, -1, 2, 127, 255, 256, 2**31 - 1, 2**31, 2**32, 2**40, 2**63 - 1, 2**63, -(2**63), 10**30, 10**400),
    *(0.5, -0.0, 1e-320, 1e300, float("nan"), float("inf"), float("-inf")),
)
WORDS = (
    *("", "x", "0", "nan", "solved", "full", "s", "../../etc/passwd", "/etc/passwd", "a/../../b", "\x00", "\x1b[31m\n"),
    *("\ud800", "é\u202e", "x" * 5000, "shards/000000000000-000000000001-0123abcd.zarr", "@", "{}", "*", "%s", "1e9"),
)
BYTES = (b"", b"\0", b"\xff" * 4, b"\xff" * 8, b"\x7f\xff\xff\xff", b"\0" * 64, b"PAR1", b"PK\x03\x04", b"../")


def mutate_bytes(data: bytes, random: Random) -> bytes:
    """Flip bits, truncate, splice, or insert huge numbers."""
    result = bytearray(data)
    for _ in range(random.choice((1, 1, 1, 2, 5, 20))):
        at = random.randrange(len(result) + 1)
        match random.randrange(7):
            case 0 | 1 if result:
                result[min(at, len(result) - 1)] ^= 1 << random.randrange(8)
            case 2 if result:
                result[min(at, len(result) - 1)] = random.randrange(256)
            case 3:
                del result[at:]
            case 4:
                del result[at : at + random.choice((1, 4, 8, 100))]
            case 5:
                result[at:at] = random.choice(BYTES)
            case 6:
                other, length = random.randrange(len(result) + 1), random.choice((1, 4, 8, 16, 64))
                result[at : at + length] = result[other : other + length]
    return bytes(result)


def mutate_word(word: str, random: Random) -> str:
    """Change a string into another string."""
    at = random.randrange(len(word) + 1)
    match random.randrange(4):
        case 0:
            return random.choice(WORDS)
        case 1:
            return word[:at] + random.choice(WORDS) + word[at:]
        case 2:
            return word[:at]
        case _:
            return (
                word[:at]
                + chr(random.choice((0, 9, 10, 27, 61, 123, 233, 0x202E, random.randrange(32, 127))))
                + word[at:]
            )


def random_value(random: Random) -> Any:
    """Return an unexpected JSON value."""
    return random.choice(
        (
            *(None, True, False, [], {}, [[]], {"": []}, [None] * 100, list(range(70)), [[[[[[[[7]]]]]]]]),
            *(random.choice(NUMBERS), random.choice(WORDS), random.choice(NUMBERS)),
        )
    )


def mutate_document(document: Any, random: Random) -> Any:
    """Change a JSON document: retype, enlarge, drop, repeat or exchange values."""
    whole = [copy.deepcopy(document)]
    for _ in range(random.choice((1, 1, 1, 2, 4))):
        parent, key = _somewhere(whole, random)
        match random.randrange(6):
            case 0 if parent is not whole:
                del parent[key]
            case 1 if parent is not whole:
                other, index = _somewhere(whole, random)
                parent[key] = copy.deepcopy(other[index]) if index in other or isinstance(other, list) else None
            case 2 if isinstance(parent, dict):
                parent[mutate_word(str(key), random)] = parent.pop(key)
            case 3 if isinstance(parent, list) and parent is not whole:
                parent[key:key] = [parent[key]] * random.choice((1, 2, 100))
            case 4 if isinstance(parent[key], str):
                parent[key] = mutate_word(parent[key], random)
            case 4 if isinstance(parent[key], int | float):
                parent[key] = parent[key] + random.choice((1, -1, 0.5)) if abs(parent[key]) < 2**60 else 0
            case _:
                parent[key] = random_value(random)
    return whole[0]


def _somewhere(whole: list[Any], random: Random) -> tuple[Any, Any]:
    """Return a random container within a document, and an existing key of it."""
    parent, key = whole, 0
    while isinstance(parent[key], dict | list) and parent[key] and random.random() < 0.85:
        parent = parent[key]
        key = random.choice([*parent] if isinstance(parent, dict) else range(len(parent)))
    return parent, key


def mutate_json(document: Any, random: Random) -> bytes:
    """Encode a mutated document as JSON; sometimes break the syntax."""
    if random.random() < 0.03:
        opening = random.choice((b"[", b'{"a":', b"[[[{" * 3))
        return opening * (DEPTH // len(opening))
    if random.random() < 0.15:
        return mutate_bytes(json.dumps(document).encode(), random)
    return json.dumps(mutate_document(document, random)).encode()


def put(path: Path, data: bytes, random: Random) -> None:
    """Write a file; rarely make a link, a pipe, a folder, a sparse file or nothing instead."""
    match random.randrange(100):
        case 0:
            path.symlink_to("/etc/passwd")
        case 1:
            os.mkfifo(path)
        case 2:
            path.mkdir()
        case 3:
            path.write_bytes(data)
            os.truncate(path, 2**33)
        case 4:
            pass
        case 5:
            path.symlink_to(path)
        case _:
            path.write_bytes(data)


def remove(path: Path) -> None:
    """Remove whatever `put` made."""
    if path.is_dir() and not path.is_symlink():
        path.rmdir()
    else:
        path.unlink(missing_ok=True)
