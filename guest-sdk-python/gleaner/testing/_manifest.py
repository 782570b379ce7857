"""Parses the parts of `lambda.toml` that a local replay needs. `gleaner build` parses all of it,
and is stricter in places. Its parser is in Rust, and a local replay needs no program of Gleaner."""

from __future__ import annotations

import math
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Dict, List, Mapping, Optional, Tuple, Union

from ._error import ReplayError, nearest, quoted
from ._limits import LIMITS
from ._table import Table

ConfigValue = Union[bool, int, float, str]
ManifestSource = Union[str, "os.PathLike[str]", Mapping[str, Any]]

KIB, MIB, SECOND = 1 << 10, 1 << 20, 1_000_000_000

COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
LARGE = ("sensor_msgs/msg/Image", COMPRESSED_IMAGE, "sensor_msgs/msg/PointCloud2")

LAMBDA_NAME = re.compile(r"[a-z][a-z0-9-]*")
ITEM_NAME = re.compile(r"[a-z][a-z0-9_-]*")
TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
TYPE = re.compile(r"[A-Za-z][A-Za-z0-9_]*/msg/[A-Z][A-Za-z0-9]*")


@dataclass(frozen=True)
class Input:
    """One ``[[input]]``."""

    name: str
    topic: str
    type_name: str
    depth: int
    hold: int
    max_size: int
    decoded_size: int


@dataclass(frozen=True)
class DeclaredModel:
    """One ``[[model]]``."""

    name: str
    has_layout: bool


@dataclass(frozen=True)
class Record:
    """The ``[record]`` table; durations in ns."""

    topics: List[str]
    preroll: int
    postroll: int
    cooldown: int


@dataclass(frozen=True)
class Manifest:
    """A validated manifest."""

    name: str
    kind: str
    entry: str
    event: Optional[str]
    backlog: str
    period_ns: int
    inputs: List[Input]
    models: List[DeclaredModel]
    record: Optional[Record]
    limits: Dict[str, int]
    config: Dict[str, ConfigValue]

    @property
    def handler(self) -> str:
        return "on_tick" if self.event is None else "on_event"


def read(source: ManifestSource, config: Mapping[str, Any]) -> Manifest:
    """Reads a manifest from its file or from a ``dict`` with the same content. ``config`` overrides
    the values of ``[config]``.

    Raises ReplayError."""
    if isinstance(source, Mapping):
        return _manifest("manifest", source, config)
    path = Path(source)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ReplayError(
            f"cannot read manifest `{path}`", str(error), 'pass manifest="path/to/lambda.toml"'
        ) from None
    return _manifest(str(path), _parsed(path, text), config)


def _parsed(path: Path, text: str) -> Mapping[str, Any]:
    try:
        import tomllib as toml
    except ImportError:  # Before Python 3.11.
        import tomli as toml  # type: ignore[no-redef, import-not-found, unused-ignore]
    try:
        parsed: Dict[str, Any] = toml.loads(text)
    except toml.TOMLDecodeError as error:
        raise ReplayError(
            f"cannot use manifest `{path}`", f"it is not valid TOML: {error}"
        ) from None
    return parsed


def _manifest(file: str, entries: Mapping[str, Any], overrides: Mapping[str, Any]) -> Manifest:
    root = Table(
        file,
        "the file",
        entries,
        ["lambda", "schedule", "input", "model", "record", "limits", "demand", "config"],
    )
    known = ["name", "version", "kind", "entry", "files", "description", "deterministic"]
    about = Table(
        file, "[lambda]", root.need("lambda", "[lambda] with name, version, kind and entry"), known
    )
    inputs = [_input(file, entry) for entry in root.list("input")]
    models = [_model(file, entry) for entry in root.list("model")]
    for what, values in {
        "[[input]] with the name": [i.name for i in inputs],
        "[[input]] with the topic": [i.topic for i in inputs],
        "[[model]] with the name": [model.name for model in models],
    }.items():
        twice = [value for value in values if values.count(value) > 1]
        if twice:
            raise root.refusal(f"has two {what} `{twice[0]}`", "keep one of them")
    event, backlog, period_ns = _schedule(root, inputs)
    return Manifest(
        name=about.form("name", 'name = "brake-dark"', LAMBDA_NAME, 63),
        kind=about.choice("kind", ["python", "wasm"], ""),
        entry=about.text("entry", 'entry = "main.py"'),
        event=event,
        backlog=backlog,
        period_ns=period_ns,
        inputs=inputs,
        models=models,
        record=_record(root),
        limits=_limits(root),
        config=_config(root, overrides),
    )


def _schedule(root: Table, inputs: List[Input]) -> Tuple[Optional[str], str, int]:
    entry = root.need(
        "schedule", '[schedule] with event = "<an input\'s name>" or period = "100ms"'
    )
    table = Table(root.file, "[schedule]", entry, ["event", "period", "backlog"])
    if ("event" in table) == ("period" in table):
        raise table.refusal(
            "needs one of `event` and `period`", "a lambda runs on one input or on the clock"
        )
    if "period" in table:
        if "backlog" in table:
            raise table.refusal(
                "has a `backlog` beside `period`",
                "remove it: missed ticks are counted, never queued",
            )
        return None, "each", table.duration("period", (10**6, 0, 3600 * SECOND))
    event = table.text("event", 'event = "<an input\'s name>"')
    woken_by = [one for one in inputs if one.name == event]
    if not woken_by:
        raise table.refusal(
            f"names no input: `{event}`", f"the inputs are {quoted(one.name for one in inputs)}"
        )
    default = "latest" if woken_by[0].type_name in LARGE else "each"
    return event, table.choice("backlog", ["each", "latest"], default), 0


def _input(file: str, entry: Any) -> Input:
    known = ["name", "topic", "type", "depth", "max_size", "decoded_size", "hold", "qos"]
    table = Table(file, "[[input]]", entry, known)
    type_name = table.form("type", 'type = "sensor_msgs/msg/Imu"', TYPE, 255)
    large = type_name in LARGE
    compressed = type_name == COMPRESSED_IMAGE
    if "decoded_size" in table and not compressed:
        raise table.refusal(f"has a `decoded_size`, and {type_name} is not decoded", "remove it")
    return Input(
        name=table.form("name", 'name = "camera"', ITEM_NAME, 63),
        topic=table.form("topic", 'topic = "/camera/front"', TOPIC, 247),
        type_name=type_name,
        depth=table.integer("depth", (1, 4 if large else 64, 65_536)),
        hold=table.integer("hold", (1, 2 if large else 8, 1024)),
        max_size=table.size("max_size", (1, 8 * MIB if large else 4 * KIB, 256 * MIB)),
        decoded_size=table.size("decoded_size", (1, 8 * MIB, 256 * MIB)) if compressed else 0,
    )


def _model(file: str, entry: Any) -> DeclaredModel:
    known = ["name", "file", "sha256", "layout", "labels", "providers", "threads"]
    table = Table(file, "[[model]]", entry, known)
    name = table.form("name", 'name = "detector"', ITEM_NAME, 63)
    return DeclaredModel(name, has_layout="layout" in table)


def _record(root: Table) -> Optional[Record]:
    if "record" not in root:
        return None
    known = ["topics", "preroll", "postroll", "store", "preroll_size", "cooldown", "max_length"]
    table = Table(root.file, "[record]", root.entries["record"], known)
    table.need("topics", 'topics = ["/imu/data"], the topics of a clip')
    roll = (0, 5 * SECOND, 600 * SECOND)
    return Record(
        topics=[str(topic) for topic in table.list("topics")],
        preroll=table.duration("preroll", roll),
        postroll=table.duration("postroll", roll),
        cooldown=table.duration("cooldown", (0, 0, 3600 * SECOND)),
    )


def _limits(root: Table) -> Dict[str, int]:
    table = Table(
        root.file, "[limits]", root.entries.get("limits", {}), [key for key, _, _ in LIMITS]
    )
    read = {"number": table.integer, "size": table.size, "duration": table.duration}
    return {key: read[unit](key, bounds) for key, unit, bounds in LIMITS}


def _config(root: Table, overrides: Mapping[str, Any]) -> Dict[str, ConfigValue]:
    entries = root.entries.get("config", {})
    items = Table(
        root.file, "[config]", entries, list(entries) if isinstance(entries, Mapping) else []
    )
    for name in overrides:
        if name not in items:
            near = nearest(name, items.entries)
            help = f"its config values are {quoted(items.entries)}"
            if near:
                help = f"did you mean `{near}`?"
            raise ReplayError(f"the lambda has no config value `{name}`", help=help)
    return {name: _item(root.file, name, entry, overrides) for name, entry in items.entries.items()}


def _item(file: str, name: str, entry: Any, overrides: Mapping[str, Any]) -> ConfigValue:
    entry = entry if isinstance(entry, Mapping) else {"default": entry}
    table = Table(file, f"`config.{name}`", entry, ["default", "min", "max", "unit", "description"])
    default = table.need(
        "default", "default = 1.0, or another value of the type that the lambda expects"
    )
    if not isinstance(default, (bool, int, float, str)) or not _is_finite(default):
        raise table.refusal(
            "has a `default` of an unsupported type", "use a number, a text, true or false"
        )
    value: Any = default if name not in overrides else _same_type(name, default, overrides[name])
    for key in ("min", "max"):
        limit: Any = table.entries.get(key, value)
        if (value < limit) if key == "min" else (value > limit):
            raise ReplayError(f"config value `{name}` cannot be {value}", f"its {key} is {limit}")
    checked: ConfigValue = value
    return checked


def _same_type(name: str, default: ConfigValue, given: Any) -> ConfigValue:
    """Converts ``given`` to the type of ``default``; a whole number is accepted for a number."""
    plain = given.item() if hasattr(given, "item") else given
    if type(default) is float and type(plain) is int:
        plain = float(plain)
    if type(plain) is not type(default) or not _is_finite(plain):
        wanted = {bool: "True or False", int: "a whole number", float: "a number", str: "a text"}[
            type(default)
        ]
        raise ReplayError(f"config value `{name}` cannot be {given!r}", help=f"use {wanted}")
    value: ConfigValue = plain
    return value


def _is_finite(value: ConfigValue) -> bool:
    return not isinstance(value, float) or math.isfinite(value)
