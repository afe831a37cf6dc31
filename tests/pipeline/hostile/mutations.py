"""Inputs that nobody made on purpose, and some that somebody might: good ones, changed by a seeded generator."""

import copy
import json
import os
from pathlib import Path
from random import Random
from typing import Any

DEEP = 100_000
NUMBERS = (
    *(0, 1, -1, 2, 127, 255, 256, 2**31 - 1, 2**31, 2**32, 2**40, 2**63 - 1, 2**63, -(2**63), 10**30, 10**400),
    *(0.5, -0.0, 1e-320, 1e300, float("nan"), float("inf"), float("-inf")),
)
WORDS = (
    *("", "x", "0", "nan", "solved", "full", "s", "../../etc/passwd", "/etc/passwd", "a/../../b", "\x00", "\x1b[31m\n"),
    *("\ud800", "é\u202e", "x" * 5000, "shards/000000000000-000000000001-0123abcd.zarr", "@", "{}", "*", "%s", "1e9"),
)
BYTES = (b"", b"\0", b"\xff" * 4, b"\xff" * 8, b"\x7f\xff\xff\xff", b"\0" * 64, b"PAR1", b"PK\x03\x04", b"../")


def changed_bytes(data: bytes, random: Random) -> bytes:
    """The same with bits flipped, cut off, spliced, or with numbers in it that are too large."""
    found = bytearray(data)
    for _ in range(random.choice((1, 1, 1, 2, 5, 20))):
        at = random.randrange(len(found) + 1)
        match random.randrange(7):
            case 0 | 1 if found:
                found[min(at, len(found) - 1)] ^= 1 << random.randrange(8)
            case 2 if found:
                found[min(at, len(found) - 1)] = random.randrange(256)
            case 3:
                del found[at:]
            case 4:
                del found[at : at + random.choice((1, 4, 8, 100))]
            case 5:
                found[at:at] = random.choice(BYTES)
            case 6:
                other, length = random.randrange(len(found) + 1), random.choice((1, 4, 8, 16, 64))
                found[at : at + length] = found[other : other + length]
    return bytes(found)


def changed_word(word: str, random: Random) -> str:
    """Text that is still some text."""
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


def odd_value(random: Random) -> Any:
    return random.choice(
        (
            *(None, True, False, [], {}, [[]], {"": []}, [None] * 100, list(range(70)), [[[[[[[[7]]]]]]]]),
            *(random.choice(NUMBERS), random.choice(WORDS), random.choice(NUMBERS)),
        )
    )


def changed_document(document: Any, random: Random) -> Any:
    """JSON's types, with some values of other types, too large, missing, twice or exchanged."""
    whole = [copy.deepcopy(document)]
    for _ in range(random.choice((1, 1, 1, 2, 4))):
        parent, key = _somewhere(whole, random)
        match random.randrange(6):
            case 0 if parent is not whole:
                del parent[key]
            case 1 if parent is not whole:
                other, place = _somewhere(whole, random)
                parent[key] = copy.deepcopy(other[place]) if place in other or isinstance(other, list) else None
            case 2 if isinstance(parent, dict):
                parent[changed_word(str(key), random)] = parent.pop(key)
            case 3 if isinstance(parent, list) and parent is not whole:
                parent[key:key] = [parent[key]] * random.choice((1, 2, 100))
            case 4 if isinstance(parent[key], str):
                parent[key] = changed_word(parent[key], random)
            case 4 if isinstance(parent[key], int | float):
                parent[key] = parent[key] + random.choice((1, -1, 0.5)) if abs(parent[key]) < 2**60 else 0
            case _:
                parent[key] = odd_value(random)
    return whole[0]


def _somewhere(whole: list[Any], random: Random) -> tuple[Any, Any]:
    """A container within, and a key of it that is there."""
    parent, key = whole, 0
    while isinstance(parent[key], dict | list) and parent[key] and random.random() < 0.85:
        parent = parent[key]
        key = random.choice([*parent] if isinstance(parent, dict) else range(len(parent)))
    return parent, key


def changed_json(document: Any, random: Random) -> bytes:
    """A file of JSON: mostly such a document, sometimes no JSON any more."""
    if random.random() < 0.03:
        opened = random.choice((b"[", b'{"a":', b"[[[{" * 3))
        return opened * (DEEP // len(opened))
    if random.random() < 0.15:
        return changed_bytes(json.dumps(document).encode(), random)
    return json.dumps(changed_document(document, random)).encode()


def put(path: Path, data: bytes, random: Random) -> None:
    """The file with these bytes; rarely a link, a pipe, a folder, a hole or nothing in its place."""
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
    if path.is_dir() and not path.is_symlink():
        path.rmdir()
    else:
        path.unlink(missing_ok=True)
