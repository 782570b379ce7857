"""Parses the names of the WIT package. Fails on syntax that it does not support."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Dict, List, Tuple

ITEM = re.compile(r"(resource|record|variant|enum)\s+([\w-]+)\s*\{")
FUNCTION = re.compile(r"([\w-]+):\s*(static\s+)?func\(([^)]*)\)[^;]*;")
ONE_LETTER = re.compile(r"borrow<([\w-]+)>")


@dataclass
class Function:
    """A function: the names of its parameters, and whether it is static."""

    parameters: List[str]
    static: bool


@dataclass
class Interface:
    functions: Dict[str, Function] = field(default_factory=dict)
    resources: Dict[str, Dict[str, Function]] = field(default_factory=dict)
    records: Dict[str, List[str]] = field(default_factory=dict)
    variants: Dict[str, List[str]] = field(default_factory=dict)
    enums: Dict[str, List[str]] = field(default_factory=dict)


def read(folder: Path) -> Dict[str, Interface]:
    """Returns all interfaces of the `.wit` files in `folder`, by name. Names are as in the WIT,
    with `-`."""
    interfaces = {}
    for path in sorted(folder.glob("*.wit")):
        text = re.sub(r"//.*", "", path.read_text(encoding="utf-8"))
        for match in re.finditer(r"\b(?:interface|world)\s+([\w-]+)\s*\{", text):
            interfaces[match.group(1)] = _interface(_block(text, match.end())[0])
    return interfaces


def _interface(text: str) -> Interface:
    interface = Interface()
    rest = text
    while match := ITEM.search(rest):
        kind, name = match.groups()
        body, end = _block(rest, match.end())
        if kind == "resource":
            interface.resources[name] = _functions(body)
        elif kind == "record":
            interface.records[name] = re.findall(r"([\w-]+)\s*:", body)
        elif kind == "variant":
            interface.variants[name] = re.findall(r"([\w-]+)(?:\([^)]*\))?\s*(?:,|$)", body.strip())
        else:
            interface.enums[name] = re.findall(r"[\w-]+", body)
        rest = rest[: match.start()] + rest[end:]
    interface.functions = _functions(rest)
    return interface


def _functions(text: str) -> Dict[str, Function]:
    return {
        name: Function([_parameter(*pair) for pair in _pairs(parameters)], bool(static))
        for name, static, parameters in FUNCTION.findall(text)
    }


def _pairs(parameters: str) -> List[Tuple[str, str]]:
    return re.findall(r"([\w-]+):\s*([^,]+(?:<[^>]*>)?)", parameters)


def _parameter(name: str, kind: str) -> str:
    """Returns the name of a parameter. In the WIT a parameter cannot have the name of a type, so a
    handle is `f: borrow<field>`; in Python it is `field`."""
    handle = ONE_LETTER.fullmatch(kind.strip())
    return handle.group(1) if handle and len(name) == 1 else name


def _block(text: str, start: int) -> Tuple[str, int]:
    """Returns the text up to the brace that closes the one before `start`, and the position after
    that brace."""
    depth = 1
    for at in range(start, len(text)):
        depth += {"{": 1, "}": -1}.get(text[at], 0)
        if depth == 0:
            return text[start:at], at + 1
    raise ValueError("a brace is not closed")
