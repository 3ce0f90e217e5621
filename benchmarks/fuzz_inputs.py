# ruff: noqa: E501 - tables
"""Malformed inputs, made of valid ones by a seed: the same seed, reader and number give the same bytes on every machine."""

from __future__ import annotations

import copy
import functools
import json
import lzma
import random
import re
import struct
import zlib
from collections.abc import Callable
from typing import Any

import yaml

HUGE = "9" * 5000  # more digits than Python turns into a number
NUMBERS = (
    "NaN", "-Infinity", "Infinity", "1e400", "-1e400", HUGE, "-1", "0", "-0.0", "1e308", "1e-320", "10000000000000000000000", "0.5", "true",
    "null", '"5"', ".inf", "-.inf", ".nan", "0x7fffffffffffffffffff", "0b" + "1" * 300, "1:1:1:1", "1_000", "2026-02-30", "1e5", "[]", "{}",
)  # fmt: skip
TEXTS = (
    "", " ", "\x00", "a\x00b", "\ud800", "\u2028", "\x1b[31mred", "é" * 300, "x" * 5000, "../../etc/passwd", "/dev/null", "os:system",
    "module:Class", "bwrap/module:Class", "kf:x=1", "kf:x=[[[[", "none", "nan", "-1", "1" * 5000, "line\nbreak", "NaN", "a.b.c", "%s", "{0}",
    "name.yaml", "name.json", "program:path=x.yaml", "steered:policy=x.json", "2026-02-30", "tailgate.cli:main", "composed:filter=kf", "=",
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2, 10**30, -(10**30), 1e308, -1e308, 1e-320, 0.5, float("nan"), float("inf"), float("-inf"), [], {}, [[]],
    [None], [0], [-1, 1e308], {"": 1}, {"name": None}, {"name": "kf"}, {"a": {"b": {"c": []}}}, ["a", "a"], [[[[[[]]]]]],
)  # fmt: skip
BYTES = (
    b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"\xc3\x28", b"\xed\xa0\x80", b"\r", b"\r\n", b"\n\n", b"\t", b'"', b"'", b"{", b"[", b"}", b"]", b":", b",",
)  # fmt: skip
TAGGED = (
    "!!python/object/apply:os.system [id]", "!!binary aGVsbG8=", "2026-11-27", "!!set {a, b}", "2026-02-30", "!!int x", "!!bool x", "!!float ''",
    "!!int ''", "!!map x", "!!timestamp x",
)  # fmt: skip
_NUMBER = re.compile(r"(?<![\w.\"])-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(r"[A-Za-z_][\w-]*")
Paths = list[tuple[Any, ...]]


def mutated(valid: bytes, form: str, rng: random.Random) -> bytes:
    """One input made of a valid file of a format: yaml, json, jsonl, xz, csv, tensors, parquet, npy or text."""
    if form == "xz":
        return _packed(valid, rng)
    if form == "tensors" and rng.random() < 0.7:
        return _tensors(valid, rng)
    if form in ("tensors", "parquet", "npy"):
        return _bytes(valid, rng)
    draw = rng.random()
    if form in ("json", "yaml", "jsonl") and draw < 0.5:
        return _structure(valid, form, rng)
    if draw < 0.75:
        return _tokens(valid, rng)
    if draw < 0.95:
        return _bytes(valid, rng)
    return _encoded(valid, rng) if draw < 0.985 else _bomb(valid, form, rng)


def _bytes(valid: bytes, rng: random.Random) -> bytes:
    """Truncations, and pieces changed, put in, taken out and doubled."""
    held = bytearray(valid)
    for _ in range(rng.choice((1, 1, 2, 4))):
        at, length = rng.randrange(len(held) + 1), min(rng.choice((1, 2, 8, 64, 4096)), len(held))
        kind = rng.randrange(6)
        if kind == 0:
            del held[at:]
        elif kind == 1:
            del held[at : at + length]
        elif kind == 2:
            held[at:at] = rng.choice(BYTES) * rng.choice((1, 1, 3))
        elif kind == 3:
            held[at:at] = held[at : at + length]
        elif kind == 4 and at < len(held):
            held[at] ^= 1 << rng.randrange(8)
        else:
            held[at : at + length] = rng.randbytes(length)
    return bytes(held)


def _encoded(valid: bytes, rng: random.Random) -> bytes:
    """The same text in another encoding, nothing, or little."""
    text = valid.decode("utf-8", "replace")
    made: tuple[Callable[[], bytes], ...] = (
        lambda: text.encode("utf-16"), lambda: text.encode("utf-16-le"), lambda: text.encode("utf-32"), lambda: b"\xef\xbb\xbf" + valid,
        lambda: b"", lambda: b"\x00" * 100, lambda: b" \n" * 50, lambda: valid.replace(b"\n", b"\r\n"), lambda: valid + valid,
        lambda: text.encode("utf-7"), lambda: b"\xff" * 50, lambda: b"null", lambda: b"[]", lambda: b"1", lambda: b'""', lambda: b"{}",
    )  # fmt: skip
    return rng.choice(made)()


def _tokens(valid: bytes, rng: random.Random) -> bytes:
    """Numbers and words changed for others, and lines doubled, lost and moved."""
    text = valid.decode("utf-8", "replace")
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        kind, start = rng.randrange(4), rng.randrange(len(text) + 1)
        if kind < 2:
            pattern, others = ((_NUMBER, NUMBERS), (_WORD, TEXTS))[kind]
            if (found := pattern.search(text, start) or pattern.search(text)) is not None:
                text = text[: found.start()] + rng.choice(others) + text[found.end() :]
            continue
        lines = text.split("\n")
        at = rng.randrange(len(lines))
        if kind == 2:
            lines.insert(rng.randrange(len(lines) + 1), lines[at])
        else:
            line = lines.pop(at)
            if rng.random() < 0.5:
                lines.append(rng.choice(("", "  ", "    ")) + line)
        text = "\n".join(lines)
    return text.encode("utf-8", "surrogatepass")


@functools.lru_cache(maxsize=8)
def _parsed(valid: bytes, form: str) -> list[Any]:
    """The values of a file: one, or one for each of its first lines."""
    text = valid.decode()
    if form == "jsonl":
        return [json.loads(line) for line in text.splitlines()]
    return [json.loads(text) if form == "json" else yaml.safe_load(text)]


def _structure(valid: bytes, form: str, rng: random.Random) -> bytes:
    """Values changed for others, lost, doubled and renamed, anywhere in what the file holds."""
    values = list(_parsed(valid, form))
    at = rng.randrange(len(values))
    values[at] = changed(values[at], rng)
    if form == "yaml":
        return yaml.safe_dump(values[0], sort_keys=False, allow_unicode=rng.random() < 0.5).encode("utf-8", "surrogatepass")
    return "\n".join(json.dumps(value) for value in values).encode() + b"\n"


def changed(value: Any, rng: random.Random) -> Any:
    """A copy of JSON data with one to three places that differ."""
    whole = {"": copy.deepcopy(value)}
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        place, key = _anywhere(whole, rng)
        kind = rng.randrange(8)
        if kind < 4:
            other = rng.choice((*VALUES, *TEXTS))
            place[key] = copy.deepcopy(other) if kind < 3 else [place[key], other]
        elif kind == 4 and place is not whole:
            del place[key]
        elif kind == 5:
            place[key] = {"name": place[key]}
        elif kind == 6 and isinstance(place, dict) and place is not whole:
            place[rng.choice(TEXTS)] = place.pop(key) if rng.random() < 0.5 else rng.choice(VALUES)
        elif isinstance(place[key], list):
            place[key] = place[key] * rng.choice((0, 2, 3))
        elif isinstance(place[key], (int, float)) and not isinstance(place[key], bool):
            place[key] = place[key] * rng.choice((-1, 0, 0.5, 2, 1e9, 1e300))
        else:
            place[key] = str(place[key])
    return whole[""]


def _anywhere(whole: Any, rng: random.Random) -> tuple[Any, Any]:
    """A list or mapping somewhere in the data, and one of its keys."""
    place, key = whole, ""
    while isinstance(inner := place[key], (dict, list)) and inner and rng.random() < 0.8:
        place, key = inner, rng.choice(list(inner)) if isinstance(inner, dict) else rng.randrange(len(inner))
    return place, key


def _bomb(valid: bytes, form: str, rng: random.Random) -> bytes:
    """Little text that means much: nesting, aliases, long numbers and long lines."""
    key = (re.findall(rb"^\W*(\w+)\W*:", valid, re.MULTILINE) or [b"a"])[0].decode()
    deep = rng.choice((200, 5000, 100_000))
    wide = "\n".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12))
    head, entry, brackets = key + ": ", '{"' + key + '": ', "[" * deep
    merged = "\n".join(f"m{i}: &m{i} {{<<: [*m{i - 1}, *m{i - 1}]}}" for i in range(1, 25))
    made = {
        "yaml": (
            f"a0: &a0 [x, x]\n{wide}\n{key}: *a11\n", head + brackets, head + "{a: " * deep + "1" + "}" * deep, head + "&b [*b]\n",
            "".join(" " * i + "a:\n" for i in range(min(deep, 1500))), head + ":".join(["1"] * deep) + "\n", f"? {key}\n" * 1000,
            head + "0x" + "f" * deep, "m0: &m0 {x: 1}\n" + merged, *(head + value + "\n" for value in TAGGED), f"? [a, b]\n: {key}\n",
        ),
        "json": (
            brackets, brackets + "]" * deep, '{"a":' * deep + "1" + "}" * deep, entry + HUGE + "}", entry + "1, " + entry[1:] + "2}",
            entry + brackets + "]" * deep + "}", entry + '"\\ud800"}', entry + "1e999}", '{"format"', "9" * deep,
        ),
        "csv": (
            't,v\n0,"' + "x" * 200_000, "t,v\n" + "0,1," * deep, "t,v\n0,1\n1e300,1\n", "t,v\n0,1\n1e12,1\n", "t,v\n0,1\x00\n1,1\n",
            "t,v\n0,1e308\n1,0\n",
        ),
        "text": (
            brackets, "x=" + brackets, "x=&a [*a]", "kf:" + "a=1," * deep, "x=" + "1" * deep, "kf:x=0x" + "f" * deep, "(" * deep, "not " * deep,
        ),
    }  # fmt: skip
    return rng.choice(made["json" if form == "jsonl" else form]).encode()


# -- compressed rows


@functools.lru_cache(maxsize=1)
def _large(valid: bytes) -> tuple[bytes, ...]:
    """Small files that hold much: a line of zeros, empty lines, and rows again and again; and one that needs much memory to unpack."""
    size, row = 700 << 20, valid.splitlines(keepends=True)[0]
    made = []
    for piece in (b"\0" * (1 << 20), b"\n" * (1 << 20), row * ((1 << 20) // len(row))):
        packer = lzma.LZMACompressor(preset=0)
        made.append(b"".join([*(packer.compress(piece) for _ in range(size // len(piece))), packer.flush()]))
    needs = lzma.compress(valid, filters=[{"id": lzma.FILTER_LZMA2, "preset": 0, "dict_size": 1 << 23}])
    return (*made, _hungry(needs))


def _hungry(packed: bytes) -> bytes:
    """The same compressed file, which says that it needs a dictionary of 3 GB."""
    head = bytearray(packed[12 : 12 + (packed[12] + 1) * 4])
    head[4] = 39  # after its size, its flags, and the name and length of the filter: 3 << 30 bytes
    head[-4:] = struct.pack("<I", zlib.crc32(head[:-4]))
    return packed[:12] + bytes(head) + packed[12 + len(head) :]


def _packed(valid: bytes, rng: random.Random) -> bytes:
    """Rows, changed, in a compressed file, or a compressed file that is changed."""
    draw = rng.random()
    if draw < 0.0015:
        return rng.choice(_large(valid))
    if draw < 0.5:
        return _bytes(lzma.compress(valid, preset=0), rng)
    if draw < 0.55:
        return lzma.compress(valid, preset=0) + rng.choice((b"\0" * 4, b"x", b"\0" * 3, lzma.compress(valid, preset=0), lzma.compress(b"x")))
    form = rng.choice((lzma.FORMAT_XZ, lzma.FORMAT_XZ, lzma.FORMAT_XZ, lzma.FORMAT_ALONE))
    return lzma.compress(mutated(valid, "jsonl", rng), form, preset=0)


# -- safetensors


def _tensors(valid: bytes, rng: random.Random) -> bytes:
    """A file of tensors whose header, numbers, or length of the header are changed."""
    (length,) = struct.unpack("<Q", valid[:8])
    header, data = json.loads(valid[8 : 8 + length]), bytearray(valid[8 + length :])
    draw = rng.random()
    if draw < 0.15:
        return struct.pack("<Q", rng.choice((0, 1, length - 1, length + 1, 2**31, 2**63, 2**64 - 1, 100_000_000))) + valid[8:]
    if draw < 0.35:
        for special in (float("nan"), float("inf"), 1e38)[: rng.randrange(1, 4)]:
            at = rng.randrange(max(len(data) // 4, 1)) * 4
            data[at : at + 4] = struct.pack("<f", special)
    elif draw < 0.9:
        header = changed(header, rng) if draw < 0.6 else _reshaped(header, rng)
    text = json.dumps(header) if draw < 0.95 else "[" * 100_000
    return struct.pack("<Q", len(text.encode())) + text.encode() + bytes(data)


def _reshaped(header: dict[str, Any], rng: random.Random) -> dict[str, Any]:
    """Tensors of another type or shape, under another name, or gone."""
    out = copy.deepcopy(header)
    name = rng.choice([key for key in out if key != "__metadata__"] or [""])
    if not name:
        return out
    kind = rng.randrange(5)
    if kind == 0:
        out[name]["dtype"] = rng.choice(("F64", "F16", "BF16", "I64", "U8", "BOOL", "F8_E4M3", "I32", "U16", "X"))
    elif kind == 1:
        out[name]["shape"] = rng.choice((out[name]["shape"][::-1], [*out[name]["shape"], 1], [], [0], [2**62, 4], [-1], [1.5], [0, 2**63 - 1]))
    elif kind == 2:
        out[rng.choice(TEXTS)] = out.pop(name)
    elif kind == 3:
        first, second = rng.choice(list(out)), name
        out[first], out[second] = out[second], out[first]
    else:
        out["__metadata__"] = changed(out.get("__metadata__", {"facts": "{}"}), rng)
    return out
