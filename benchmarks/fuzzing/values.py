"""Hostile values and mutations of valid ones: Python objects, JSON and TOML trees, texts, bytes.

Every random choice comes from the `random.Random` that is passed in.
"""

import copy
import json
from collections.abc import Sequence
from random import Random
from typing import Any

DEEP_NESTING = 100_000  # levels
OUTSIDE_PATH = "../kept/notes.txt"  # a file outside the case's folder, relative to it; a case that changes it fails


class RawLiteral(str):
    """JSON or TOML source that is written verbatim, valid or not."""


_NUMBERS = (
    *("0", "-0.0", "-1", "0.5", "1e400", "-1e400", "1e-400", "1e308", "-1e308", str(2**31), str(-(2**31)), str(2**63)),
    *(str(2**64), "1" + "0" * 400, "9" * 5000, "-" + "9" * 5000, "1e-9", "3", "255", "65536"),
)
_JSON = (
    *("NaN", "Infinity", "-Infinity", "null", "true", "false", "[]", "{}", "[[]]", "[1, 2, 3]", '"\\ud800"', "nul"),
    *('{"a": 1}', "[null]", '"\\u0000"', '"\\ufeff"', "01", "1.", '"\t"', "'a'"),
)
_TOML = (
    *("nan", "inf", "-inf", "true", "[]", "{}", "[[]]", "[1, 2, 3]", "1979-05-27T07:32:00Z", "07:32:00", "0xffff"),
    *("{a = 1}", '[1, "a"]', "[nan]", "[inf, -inf]", "'a'", "bare", '"\\ud800"', "[{}]", "1_000", '"\\u0000"', ""),
)
_WORDS = (
    *("", " ", ".", "..", "/", "~", "a/b", OUTSIDE_PATH, "../../../../etc/passwd", "/etc/passwd", "/dev/null"),
    *("a:b:c", "+"),
    *("\x00", "a\x00b", "\ud800", "\udcff", "\ufeff", "\x07\x1b[31m", "a\nb", "a\r\nb", "\u202e", "é", "²", "∞", "'"),
    *("nan", "inf", "-inf", "1e400", "-1", "0", "9" * 5000, "1" + "0" * 400, "x" * 300, "%s%n", "{}", "{0}", "<b>&"),
    *("training", "held-out", "any", "+randomised", "day:night:nan", "day:night:2", "day", "true", "None", '"', "\\"),
)
_OBJECTS: tuple[Any, ...] = (
    *(None, True, False, 0, -0.0, -1, 1, 2, 0.5, float("nan"), float("inf"), -float("inf"), 1e308, -1e308, 2**31),
    *(2**63, -(2**63), 10**400, 10**5000, (), [], {}, [[]], [None], (1, 2, 3), {"a": 1}, b"", b"\xff", 1j, object()),
    *(int, range(3), {1, 2}, (float("nan"), 90), (0, 0), (2**31, 2**31), (-1, 8), ("a", "b"), [1e400, 8]),
)


def hostile_text(rng: Random) -> str:
    """A hostile text; in 1 % of calls it has a megabyte."""
    return "x" * 1_000_000 if rng.random() < 0.01 else rng.choice(_WORDS)


def hostile_value(rng: Random) -> Any:
    """A hostile Python value."""
    which = rng.random()
    if which < 0.3:
        return hostile_text(rng)
    if which < 0.32:
        return nested(500 if which < 0.31 else DEEP_NESTING)
    return rng.choice(_OBJECTS)


def nested(levels: int) -> list[Any]:
    """A list nested this many levels deep."""
    out: list[Any] = []
    for _ in range(levels):
        out = [out]
    return out


def hostile_literal(rng: Random, toml: bool = False) -> RawLiteral:
    """JSON or TOML source of a hostile value, valid or not."""
    which = rng.random()
    if which < 0.35:
        return RawLiteral(rng.choice(_NUMBERS))
    if which < 0.6:
        return RawLiteral(json.dumps(hostile_text(rng)))
    if which < 0.94:
        return RawLiteral(rng.choice(_TOML if toml else _JSON))
    levels = rng.choice((50, 900, 5000, DEEP_NESTING))
    equals = "=" if toml else ":"
    key = "a" if toml else '"a"'
    return RawLiteral(
        rng.choice(
            (
                "[" * levels,
                "[" * levels + "]" * levels,
                f"{{{key}{equals}" * levels,
                f"{{{key}{equals}" * levels + "1" + "}" * levels,
            )
        )
    )


def mutated(rng: Random, table: Any, toml: bool = False) -> Any:
    """A copy of a tree of dicts and lists with one to three changes: entries replaced, removed, copied or renamed."""
    out = copy.deepcopy(table)
    for _ in range(rng.choice((1, 1, 2, 3))):
        slots = _slots(out)
        if not slots:
            return hostile_literal(rng, toml)
        holder, key = rng.choice(slots)
        what = rng.random()
        if what < 0.65:
            holder[key] = hostile_literal(rng, toml)
        elif what < 0.75:
            del holder[key]
        elif what < 0.85:
            other, its = rng.choice(slots)
            if its in other if isinstance(other, dict) else its < len(other):
                holder[key] = copy.deepcopy(other[its])
        elif isinstance(holder, dict):
            name = hostile_text(rng) if toml is False else rng.choice(("a.b", '""', '"\\u0000"', "frames", "x" * 300))
            holder[name if what < 0.93 else key + "s"] = holder[key] if what < 0.93 else hostile_literal(rng, toml)
        else:
            holder.extend([holder[key]] * rng.choice((1, 3, 1000)))
    return out


def _slots(tree: Any) -> list[tuple[Any, Any]]:
    """Container and key of every entry of a tree, up to about 2,000."""
    out: list[tuple[Any, Any]] = []
    stack = [tree]
    while stack and len(out) < 2000:
        here = stack.pop()
        keys: Sequence[Any] = list(here) if isinstance(here, dict) else range(len(here))
        for key in keys:
            out.append((here, key))
            if isinstance(here[key], dict | list):
                stack.append(here[key])
    return out


def json_text(tree: Any) -> str:
    """JSON source of a tree; its `RawLiteral` values are written verbatim."""
    if isinstance(tree, RawLiteral):
        return str(tree)
    if isinstance(tree, dict):
        return "{" + ", ".join(f"{json.dumps(str(k))}: {json_text(v)}" for k, v in tree.items()) + "}"
    if isinstance(tree, list | tuple):
        return "[" + ", ".join(map(json_text, tree)) + "]"
    return json.dumps(tree)


def toml_text(table: dict[str, Any]) -> str:
    """TOML source of a table; its `RawLiteral` values are written verbatim, nested tables inline."""
    return "".join(f"{key} = {_toml(value)}\n" for key, value in table.items())


def _toml(value: Any) -> str:
    if isinstance(value, RawLiteral):
        return str(value)
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return json.dumps(value)


def mutated_json(rng: Random, tree: Any) -> bytes:
    """JSON of a mutated copy of a tree, further mutated by `mutated_text`."""
    return mutated_text(rng, json_text(mutated(rng, tree)))


def mutated_text(rng: Random, text: str) -> bytes:
    """A text as bytes.

    It is unchanged (60 %), has a byte order mark, another encoding, an inserted character, or a very long or deeply
    nested prefix, or is corrupted.
    """
    what = rng.random()
    if what < 0.6:
        return text.encode("utf-8", "surrogatepass")
    if what < 0.65:
        return b"\xef\xbb\xbf" + text.encode("utf-8", "surrogatepass")
    if what < 0.7:
        return text.encode(rng.choice(("utf-16", "utf-32")), "surrogatepass")
    if what < 0.85:
        at = rng.randrange(len(text) + 1)
        text = text[:at] + rng.choice(("\x00", "\x1b", "\n", '"', "[", "=", ",", "\ufeff", "\r", "ÿ")) + text[at:]
        return text.encode("utf-8", "surrogatepass")
    if what < 0.87:
        return (
            rng.choice(("a." * DEEP_NESTING + "a = 1\n", "[" + "a." * 5000 + "a]\n", "x" * 1_000_000)) + text
        ).encode("utf-8", "surrogatepass")
    return corrupted(rng, text.encode("utf-8", "surrogatepass"))


def corrupted(rng: Random, data: bytes) -> bytes:
    """Bytes with one to five changes: flipped, cut, inserted, doubled, emptied or overwritten by extreme numbers."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 5))):
        n = len(out)
        what = rng.random()
        near = rng.random() < 0.5  # headers are at the start
        at = rng.randrange(min(n, 128) if near else n) if n else 0
        if what < 0.35 and n:
            out[at] ^= 1 << rng.randrange(8)
        elif what < 0.5:
            del out[at:]
        elif what < 0.75 and n:
            size = rng.choice((1, 2, 4, 8))
            number = rng.choice((0, 1, 0x7F, 2**31 - 1, 2**31, 2**63 - 1, 2**64 - 1, rng.getrandbits(64)))
            number %= 256**size
            out[at : at + size] = number.to_bytes(size, rng.choice(("little", "big")))
        elif what < 0.85:
            out[at:at] = rng.randbytes(rng.choice((1, 4, 100)))
        elif what < 0.93:
            del out[at : at + rng.choice((1, 4, 100))]
        elif what < 0.96:
            out[at : at + 64] = bytes(len(out[at : at + 64]))
        elif what < 0.98:
            out += out[: 1 << 16]
        else:
            out = bytearray(rng.choice((b"", b"\x00", b"\x00" * 4096, rng.randbytes(300), bytes(data[:1]))))
    return bytes(out)
