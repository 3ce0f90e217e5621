"""Readers of untrusted files, one per format, with limits on size, depth and numbers. They execute nothing.

They raise OSError if a file is unreadable or too large, and ValueError for malformed content.
"""

from __future__ import annotations

import copy
import errno
import json
import lzma
import re
import sys
from collections.abc import Callable, Iterator
from functools import lru_cache
from math import isfinite
from pathlib import Path
from typing import Any, NoReturn

import yaml
from safetensors import SafetensorError

YAML_ENDS = (".yaml", ".yml")  # of file names
LARGEST = 64 << 20  # [bytes] of a JSON, CSV or JSON Lines file that is read as a whole
YAML = 256 << 10  # [bytes] of a YAML file; parsing this much takes seconds
NODES = 100_000  # values of a YAML file; an alias counts each time it is used
TENSORS = 4 << 30  # [bytes] of a file of tensors, such as a checkpoint with a replay buffer
LINE = 4 << 20  # [bytes] of a line of JSON
ROWS = 8_000_000_000  # [bytes] of unpacked rows of a compressed file
FREE, RATIO = 16 << 20, 200  # [bytes] that every file may unpack to, and the largest ratio above that: hashes do not compress
DICTIONARY = 256 << 20  # [bytes] of memory for unpacking
DEPTH = 64  # of nested lists and mappings
DIGITS = 200  # of a number in a YAML file
LARGEST_FLOAT = int(sys.float_info.max)
_PIECE = 1 << 20


def read_bytes(path: Path, most: int = LARGEST) -> bytes:
    """Return the content of a file, pipe or device of at most `most` bytes."""
    held = bytearray()
    for piece in _pieces(path):
        held += piece
        if len(held) > most:
            raise OSError(errno.EFBIG, f"more than {most} bytes")
    return bytes(held)


def _opened(path: Path) -> Any:
    try:
        return path.open("rb")
    except ValueError as error:  # a zero byte in its name
        raise OSError(errno.EINVAL, str(error)) from None


# -- JSON


def parse_json(content: bytes | str, strict: bool = True) -> Any:
    """Read JSON text; refuse duplicate keys, deep nesting, and whole numbers too large for a float.

    `strict` also refuses NaN, infinity and lone surrogates, which Python's writer allows by default.
    """
    text = content.decode("utf-8") if isinstance(content, bytes) else content
    rules: dict[str, Any] = {"object_pairs_hook": _once}
    if strict:
        rules["parse_constant"] = _no_number
    try:
        data = json.loads(text, **rules)
    except RecursionError:
        raise _deep() from None
    _checked(data, strict)
    if strict and (r"\ud" in text or r"\uD" in text):  # a lone surrogate, which cannot be encoded
        json.dumps(data, ensure_ascii=False).encode()
    return data


def load_json(path: Path, strict: bool = True) -> Any:
    """Read a JSON file, as `parse_json` does; unpack one named *.xz."""
    return parse_json(_unpacked_whole(path) if path.suffix == ".xz" else read_bytes(path), strict)


def _unpacked_whole(path: Path) -> bytes:
    """Return the unpacked content of a file. Raises ValueError for one that is damaged, OSError for one that unpacks to too much."""
    held = bytearray()
    try:
        for piece in _unpacked(path):
            held += piece
            if len(held) > LARGEST:
                raise OSError(errno.EFBIG, f"more than {LARGEST} bytes unpacked")
    except (EOFError, lzma.LZMAError) as error:
        raise ValueError(f"no whole xz file ({error})") from None
    return bytes(held)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    out = dict(pairs)
    if len(out) != len(pairs):
        names = [key for key, _ in pairs]
        raise ValueError(f"the key {next(key for key in names if names.count(key) > 1)[:100]!r} appears twice")
    return out


def _no_number(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not a JSON number")


def _deep() -> ValueError:
    return ValueError(f"lists and mappings nested more than {DEPTH} deep")


def _checked(data: object, strict: bool) -> None:
    """Raise ValueError for deep nesting or a number too large for a float."""
    held: list[Any] = [data]
    for _ in range(DEPTH + 1):
        for value in held:
            kind = type(value)
            if (kind is float and strict and not isfinite(value)) or (kind is int and abs(value) > LARGEST_FLOAT):
                raise ValueError("a number that is too large")
        outer = [value.values() if isinstance(value, dict) else value for value in held if isinstance(value, (dict, list))]
        held = [value for values in outer for value in values]
        if not held:
            return
    raise _deep()


# -- JSON Lines


def lines_of(path: Path) -> Iterator[bytes]:
    """Yield the lines of a file with their line ends; unpack a file named *.xz.

    Raises EOFError if a compressed file is truncated.
    """
    rest = b""
    for piece in _unpacked(path) if path.suffix == ".xz" else _pieces(path):
        *whole, rest = (rest + piece).split(b"\n")
        for line in whole:
            yield line + b"\n"
        if len(rest) > LINE:
            raise OSError(errno.EFBIG, f"a line of more than {LINE} bytes")
    if rest:
        yield rest


def _pieces(path: Path) -> Iterator[bytes]:
    with _opened(path) as file:
        while piece := file.read(_PIECE):
            yield piece


def _unpacked(path: Path) -> Iterator[bytes]:
    """Yield the unpacked content of a file of one or more concatenated xz streams, piece by piece."""
    read, out, reader, begun = 0, 0, lzma.LZMADecompressor(memlimit=DICTIONARY), False
    for packed in _pieces(path):
        read += len(packed)
        while packed or (begun and not reader.eof and not reader.needs_input):
            if reader.eof:  # another stream follows, or zero padding up to a multiple of four
                packed = packed.lstrip(b"\0")
                if not packed:
                    break
                reader, begun = lzma.LZMADecompressor(memlimit=DICTIONARY), False
            piece, begun = reader.decompress(packed, _PIECE), True
            packed = reader.unused_data
            out += len(piece)
            if out > ROWS or out > FREE + RATIO * read:
                raise OSError(errno.EFBIG, f"{read} bytes that unpack to {out} or more: rows do not compress that well")
            yield piece
    if not reader.eof:
        raise EOFError("the file is truncated")


# -- YAML


class _Plain(yaml.SafeLoader):
    """A safe loader of the kinds of values that JSON has; it refuses duplicate keys."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.depth = 0
        self.sizes: dict[int, int] = {}  # number of values in each node, itself included

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event, alias = self.peek_event(), self.check_event(yaml.AliasEvent)  # type: ignore[no-untyped-call]
        self.depth += 1
        if self.depth > DEPTH:
            raise yaml.composer.ComposerError(None, None, str(_deep()), event.start_mark)
        node = super().compose_node(parent, index)
        self.depth -= 1
        if node is not None and not alias:
            self.sizes[id(node)] = 1 + self._below(node)
        if node is None or self.sizes.get(id(node), NODES + 1) > NODES:  # an alias inside its own anchor has no size yet
            what = "an alias that is part of itself" if alias and id(node) not in self.sizes else f"more than {NODES} values"
            raise yaml.composer.ComposerError(None, None, what, event.start_mark)
        if isinstance(node, yaml.ScalarNode) and node.tag.endswith((":int", ":float")) and len(node.value) > DIGITS:
            raise yaml.composer.ComposerError(None, None, f"a number of more than {DIGITS} digits", event.start_mark)
        return node

    def _below(self, node: yaml.Node) -> int:
        if isinstance(node, yaml.MappingNode):
            return sum(self.sizes[id(part)] for pair in node.value for part in pair)
        return sum(self.sizes[id(part)] for part in node.value) if isinstance(node, yaml.SequenceNode) else 0

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if key.tag != "tag:yaml.org,2002:merge" and isinstance(key.value, str) and key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"the key {key.value[:100]!r} appears twice", key.start_mark)
            if isinstance(key.value, str):
                seen.add(key.value)
        return super().construct_mapping(node, deep)

    def no_value(self, node: yaml.Node) -> NoReturn:
        """Refuse a value that JSON cannot express, such as a date."""
        kind = str(node.tag).rpartition(":")[2][:100]
        raise yaml.constructor.ConstructorError(None, None, f"a {kind} instead of a text, number, list or mapping", node.start_mark)


_KINDS = {f"tag:yaml.org,2002:{kind}" for kind in ("null", "bool", "int", "float", "str", "seq", "map")}
_Plain.yaml_constructors = {tag: made for tag, made in yaml.SafeLoader.yaml_constructors.items() if tag in _KINDS} | {None: _Plain.no_value}


_Plain.yaml_implicit_resolvers = {key: list(held) for key, held in yaml.SafeLoader.yaml_implicit_resolvers.items()}
_EXPONENT = re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+$")  # a number without a point, which YAML 1.1 takes for text
_Plain.add_implicit_resolver("tag:yaml.org,2002:float", _EXPONENT, list("-+0123456789"))


def parse_yaml(text: str) -> Any:
    """Read YAML text; refuse duplicate keys, deep nesting, large aliases, and kinds of values that JSON lacks."""
    if len(text) > YAML:
        raise ValueError(f"more than {YAML} characters")
    return copy.deepcopy(_parsed(text))


@lru_cache(maxsize=128)
def _parsed(text: str) -> Any:
    try:
        return _Plain(text).get_single_data()
    except (yaml.YAMLError, LookupError, OverflowError, RecursionError) as error:
        raise ValueError(" ".join(str(error).split())) from None


def load_yaml(path: Path) -> Any:
    """Read a YAML file, as `parse_yaml` does."""
    return parse_yaml(read_bytes(path, YAML).decode("utf-8"))


# -- tensors


def tensors_of(blob: bytes, load: Callable[[bytes], dict[str, Any]]) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the tensors of a safetensors file, as `load` makes them, and its metadata."""
    try:
        tensors = load(blob)
    except (SafetensorError, KeyError, TypeError, OverflowError, RuntimeError) as error:  # also for unknown number types
        raise ValueError(str(error)) from None
    length = int.from_bytes(blob[:8], "little")
    return tensors, parse_json(blob[8 : 8 + length]).get("__metadata__") or {}
