"""Damage to the bytes of a file, as by broken disks, cut transfers, and hands that edit headers."""

import re
import struct

import numpy as np

#: numbers that programs forget: none, the ends of the integer types, and a little more or less
WILD = (0, 1, 2, 255, *(1 << n for n in (15, 20, 31, 40)), *((1 << n) - 1 for n in (16, 31, 32, 63)))


def damaged(content, rng):
    """Return the content after one to three mishaps."""
    content = bytearray(content)
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        if len(content) < 8:
            break
        KINDS[int(rng.integers(len(KINDS)))](content, rng)
    return bytes(content)


def _place(content, rng, size=1):
    """Draw a place for ``size`` bytes, often near the ends, where headers and tables are."""
    last = max(0, len(content) - size)
    where = rng.integers(3)
    away = int(rng.integers((last if where == 0 else min(last, 400)) + 1))
    return last - away if where == 2 else away


def flip_bits(content, rng):
    for _ in range(int(rng.integers(1, 9))):
        content[_place(content, rng)] ^= 1 << int(rng.integers(8))


def _part(content, rng, end):
    """Draw a part of fewer than so many bytes; return it with its length."""
    size = int(rng.integers(1, end))
    place = _place(content, rng, size)
    return slice(place, place + size), min(size, len(content) - place)


def change_bytes(content, rng):
    part, size = _part(content, rng, 33)
    content[part] = rng.bytes(size)


def zero_block(content, rng):
    part, size = _part(content, rng, max(2, len(content) // 3))
    content[part] = bytes(size)


def cut(content, rng):
    del content[_place(content, rng) :]


def remove(content, rng):
    del content[_part(content, rng, 65)[0]]


def insert(content, rng):
    place = _place(content, rng)
    content[place:place] = rng.bytes(int(rng.integers(1, 65)))


def swap_blocks(content, rng):
    size = int(rng.integers(1, max(2, len(content) // 4)))
    a, b = sorted((_place(content, rng, size), _place(content, rng, size)))
    if b - a >= size:
        content[a : a + size], content[b : b + size] = content[b : b + size], content[a : a + size]


def wild_integer(content, rng):
    code = str(rng.choice(list("BHIQ")))
    size = struct.calcsize(code)
    value = WILD[int(rng.integers(len(WILD)))] & ((1 << 8 * size) - 1)
    place = _place(content, rng, size)
    content[place : place + size] = struct.pack(str(rng.choice(["<", ">"])) + code, value)


def copied_word(content, rng):
    """Put a word of the file at another place: pointers that run in circles."""
    size = int(rng.choice([2, 4, 8]))
    a, b = _place(content, rng, size), _place(content, rng, size)
    content[b : b + size] = content[a : a + size]


def pointer_to_itself(content, rng):
    size, place = int(rng.choice([4, 8])), _place(content, rng, 8)
    order = "little" if rng.integers(2) else "big"
    content[place : place + size] = int(place - rng.integers(0, min(place, 64) + 1)).to_bytes(size, order)


def other_number(content, rng):
    """Change a number that is written in digits (FITS, npy, JSON, YAML, CSV, XML)."""
    numbers = list(re.finditer(rb"\d+", bytes(content)))
    if numbers:
        match = numbers[int(rng.integers(len(numbers)))]
        text = str(WILD[int(rng.integers(len(WILD)))])
        text = str(rng.choice([text, f"-{text}", f"{text}.5", "1e400", "nan", text * 40])).encode()
        if rng.integers(2):  # at the same length, as in the cards of FITS
            text = text[: len(match[0])].rjust(len(match[0]))
        content[match.start() : match.end()] = text


KINDS = (
    flip_bits, change_bytes, zero_block, cut, remove, insert, swap_blocks, wild_integer, wild_integer,
    copied_word, pointer_to_itself, other_number,
)  # fmt: skip


def frames(seed=3, n=6, shape=(8, 9), dtype="uint16"):
    """Return a small stack (frame, y, x)."""
    top = min(int(np.iinfo(dtype).max), 4000)
    return np.random.default_rng(seed).integers(90, top if top < 300 else 130, (n, *shape), dtype=dtype)
