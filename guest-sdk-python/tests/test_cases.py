"""Checks the rules of `gleaner.testing` against the calls and results in `rules/cases`, which
`gleaner-rules` and so the host pass."""

from __future__ import annotations

import json
import unittest
from types import SimpleNamespace
from typing import Any, Callable, Dict, Iterator, List, Tuple
from unittest.mock import Mock

import numpy as np

import home
from gleaner.data import DataError, Guid
from gleaner.scratch import ScratchError
from gleaner.testing import _manifest, _pixels, _replay, _units
from gleaner.testing._data import Field, FieldCache, Sample, InputState, Topic
from gleaner.testing._frame import Budget
from gleaner.testing._path import FieldPath, _segments
from gleaner.testing._ring import Arrival, Ring
from gleaner.testing._schedule import Event, Periodic, Tick
from gleaner.testing._session import Scratch, Session, piece
from gleaner.trigger import TriggerError

MS = 1_000_000
LIMITS = {
    "events_per_minute": 12_000,
    "log_lines": 100,
    "log_bytes": 400 << 10,
    "call_bytes": 1 << 20,
}
REFUSALS = (DataError, ScratchError, TriggerError)

Calls = Dict[str, Callable[..., Any]]


def plain(given: Any) -> Any:
    """Expands values that JSON abbreviates or cannot express: long texts, and NaN and
    infinities."""
    if isinstance(given, dict) and "times" in given:
        return given["of"] * given["times"]
    return float(given["float"]) if isinstance(given, dict) and "float" in given else given


def refusal(call: Callable[[], Any]) -> Any:
    """Returns the result of a call, or kind and text of its error."""
    try:
        return call()
    except REFUSALS as error:
        return [error.kind, str(error)]


def refused(call: Callable[[], object]) -> Any:
    """Returns the text of the error of a call, if there is one."""
    try:
        call()
    except DataError as error:
        return str(error)
    return None


def arrival(seq: int, size: int) -> Arrival:
    return Arrival(seq, seq, Guid(0, 0), seq, bytes(4 + size))


class Cases(unittest.TestCase):
    def replay(self, rule: str, start: Callable[[Dict[str, Any]], Calls]) -> None:
        for case in json.loads(
            (home.CHECKOUT / "rules" / "cases" / f"{rule}.json").read_text(encoding="utf-8")
        ):
            if "not in Python" in case:
                continue
            calls = start(case["given"])
            for n, (call, *arguments, wanted) in enumerate(case["calls"]):
                found = calls[call](*map(plain, arguments))
                found = json.loads(json.dumps(found))
                self.assertEqual(found, wanted, f"{rule}: {case['name']}: call {n}, {call}")

    def test_schedule(self) -> None:
        def periodic(given: Dict[str, Any]) -> Calls:
            schedule = Periodic(given["period_ns"])
            return {
                "begin": schedule.begin,
                "ticks": lambda now_ns: list(schedule.ticks(now_ns)),
                "missed": lambda: schedule.missed_total,
            }

        def event(given: Dict[str, Any]) -> Calls:
            source: Any = SimpleNamespace(ring=Ring(given["depth"], given["hold"], 8), skipped=0)
            schedule = Event(source)

            def arrive(samples: int) -> None:
                for _ in range(samples):
                    source.ring.push(arrival(source.ring.head, 0))

            return {
                "arrive": arrive,
                "wakes": lambda: [cell.position for _, cell in schedule.events()],
                "skipped": lambda: source.skipped,
            }

        self.replay(
            "schedule", lambda given: periodic(given) if "period_ns" in given else event(given)
        )

    def test_faults(self) -> None:
        notes = {_replay.REINITIALISED: "re-initialised", _replay.BACKING_OFF: "backs off"}

        def start(_: Dict[str, Any]) -> Calls:
            run = _replay._ReplayLoop.__new__(_replay._ReplayLoop)
            run._session, run._decisions = Session(LIMITS), []
            run._drive = SimpleNamespace(start_ns=0)  # type: ignore[assignment]
            run._in_a_row, run._backoff_ns, run._backoff = 0, 0, (0, 0)

            def wake(at_ms: int, faults: bool) -> Any:
                fault = None
                if faults:
                    fault = SimpleNamespace(kind="exception", message="", allowed=None)
                run._guest = SimpleNamespace(wake=lambda _: fault)  # type: ignore[assignment]
                decided, noted = len(run._decisions), len(run._session.lines)
                run._wake(at_ms * MS, Tick(at_ms * MS, 0))
                lines = [notes[line.message] for line in run._session.lines[noted:]]
                return lines if len(run._decisions) > decided else "backs off"

            return {"wake": wake}

        self.replay("faults", start)

    def test_triggers(self) -> None:
        def start(given: Dict[str, Any]) -> Calls:
            session = Session({**LIMITS, "events_per_minute": given["per_minute"]})

            def cause(kind: str, label: str, score: Any, attributes: List[Tuple[str, Any]]) -> Any:
                named = {plain(key): plain(value) for key, value in attributes}
                return refusal(lambda: session.cause(kind, label, score, named))

            return {
                "begin": session.begin,
                "end": lambda: [trigger.label for trigger in session.end()],
                "init": lambda label: self.in_init(session, label),
                "event": lambda label, score, attributes: cause("event", label, score, attributes),
                "start": lambda label, attributes: cause("start", label, None, attributes),
                "stop": lambda label: cause("stop", label, None, []),
                "refused": lambda: session.triggers_refused,
            }

        self.replay("triggers", start)

    def in_init(self, session: Session, label: str) -> Any:
        caused = session.suspend()
        answer = refusal(lambda: session.cause("event", label, 1.0, {}))
        session.resume(caused)
        return answer

    def test_log(self) -> None:
        def start(given: Dict[str, Any]) -> Calls:
            session = Session({**LIMITS, "log_lines": given["lines"], "log_bytes": given["bytes"]})

            def written(write: Callable[[], None], at_ns: int) -> Any:
                session.now_ns, before = at_ns, len(session.lines)
                write()
                return [len(line.message.encode()) for line in session.lines[before:]]

            return {
                "log": lambda at_ns, line: written(lambda: session.log("info", line), at_ns),
                "note": lambda at_ns, line: written(lambda: session.note(line), at_ns),
                "dropped": lambda: session.log_dropped,
            }

        self.replay("log", start)

    def test_scratch(self) -> None:
        def start(given: Dict[str, Any]) -> Calls:
            scratch = Scratch({"scratch": given["granted"], "call_bytes": given["call_bytes"]})

            def fill(entries: int) -> None:
                for n in range(entries):
                    scratch.put(str(n), b"")

            return {
                "put": lambda name, kept: refusal(lambda: scratch.put(name, kept.encode())),
                "fill": fill,
                "append": lambda name, kept: refusal(lambda: scratch.append(name, kept.encode())),
                "get": lambda name, offset, len: refusal(
                    lambda: scratch.get(name, offset, len).decode()
                ),
                "remove": lambda name: refusal(lambda: scratch.remove(name)),
                "entries": scratch.entries,
                "free": scratch.free,
            }

        self.replay("scratch", start)

    def test_ring(self) -> None:
        def start(given: Dict[str, Any]) -> Calls:
            ring, held = Ring(given["depth"], given["hold"], given["max_size"]), {}

            def hold(position: int) -> bool:
                cell = ring.get(position)
                if cell is not None:
                    held[position] = cell.lease()
                return cell is not None

            def let_go(position: int) -> None:
                held.pop(position, None)

            def shows(most: int) -> List[int]:
                return [cell.position for cell in ring.newest_while(most, lambda _: True)]

            return {
                "push": lambda size: ring.push(arrival(ring.head, size)),
                "hold": hold,
                "let go": let_go,
                "shows": shows,
                "since": lambda at: [
                    it.position for it in ring.newest_while(99, lambda found: found.at_ns > at)
                ],
                "counts": lambda: [ring.head, ring.overwritten, ring.no_slot, ring.too_big],
            }

        self.replay("ring", start)

    def test_clamps(self) -> None:
        def start(given: Dict[str, Any]) -> Calls:
            limits = {"call_bytes": given["bytes"], "call_items": given["items"]}
            values: Dict[str, Any] = {"text": "x", "bytes": b"x", "texts": ["x"]}

            def samples(asked: int) -> int:
                ring = Mock(newest_while=Mock(return_value=[]))
                source: Any = SimpleNamespace(ring=ring, limits=limits)
                Topic(source).last(asked)
                most: int = ring.newest_while.call_args.args[0]
                return most

            def value(path: str, sort: str, size: int) -> Any:
                found: Any = np.zeros(size) if sort == "numbers" else 1
                if sort in values:
                    found = values[sort] * size
                source: Any = SimpleNamespace(limits=limits, message=lambda _: None)
                fields: Any = SimpleNamespace(
                    of=lambda _: SimpleNamespace(text=path, value=lambda _: found)
                )
                lease: Any = SimpleNamespace(cell=None)
                sample = Sample(source, fields, lease)
                return refused(lambda: sample.get(path))

            def elsewhere(path: str, *inputs: str) -> Any:
                own, other = (SimpleNamespace(declared=SimpleNamespace(name=n)) for n in inputs)
                field = Field(own, SimpleNamespace(text=path))  # type: ignore[arg-type]
                return refused(lambda: FieldCache(other).of(field))  # type: ignore[arg-type]

            def no_number(path: str, type_name: str) -> Any:
                source: Any = SimpleNamespace(
                    declared=SimpleNamespace(type_name=type_name), message=lambda _: None
                )
                array = FieldPath(path, (), None, is_array=True)  # type: ignore[arg-type]
                cell: Any = SimpleNamespace()
                return refused(lambda: InputState.number(source, cell, array))

            def place(whole: int, offset: int, size: int) -> List[int]:
                found = piece(bytes(range(whole)), offset, size, given["bytes"])
                return [found[0] if found else min(offset, whole), len(found)]

            untyped: Any = SimpleNamespace(types=None, declared=SimpleNamespace(type_name=""))
            too_long = FieldCache(untyped)
            return {
                "samples": samples,
                "value": value,
                "piece": place,
                "path": lambda path: refused(lambda: too_long.at(path)),
                "elsewhere": elsewhere,
                "no number": no_number,
            }

        self.replay("clamps", start)

    def test_paths(self) -> None:
        calls: Calls = {
            "segments": _segments,
            "malformed": lambda path: refused(lambda: _segments(path)),
        }
        self.replay("paths", lambda _: calls)

    def test_units(self) -> None:
        def read(parse: Callable[[str], int], written: str) -> Any:
            try:
                return parse(written)
            except ValueError:
                return None

        calls: Calls = {
            "size": lambda written: read(_units.size, written),
            "duration": lambda written: read(_units.duration, written),
        }
        self.replay("units", lambda _: calls)

    def test_names(self) -> None:
        calls: Calls = {
            "lambda": lambda name: bool(_manifest.LAMBDA_NAME.fullmatch(name)) and len(name) <= 63,
            "item": lambda name: bool(_manifest.ITEM_NAME.fullmatch(name)) and len(name) <= 63,
            "topic": lambda name: bool(_manifest.TOPIC.fullmatch(name)) and len(name) <= 247,
            "type": lambda name: bool(_manifest.TYPE.fullmatch(name)) and len(name) <= 255,
        }
        self.replay("names", lambda _: calls)

    def test_frames(self) -> None:
        def start(given: Dict[str, Any]) -> Calls:
            budget, taken = Budget({**LIMITS, **given}), list[Any]()

            def take(size: int) -> Any:
                def one_more() -> None:
                    taken.append(budget.take(size))

                return refused(one_more)

            def give_back(at: int) -> None:
                del taken[at]

            return {"take": take, "give back": give_back}

        self.replay("frames", start)

    def test_pixels(self) -> None:
        self.replay("pixels", pixels)


def pixels(given: Dict[str, Any]) -> Calls:
    data = np.frombuffer(bytes.fromhex(given["data"]), dtype=np.uint8)
    shape = (given["width"], given["height"], given["encoding"], given["step"], given["big_endian"])

    def outcome(operation: str, call: Callable[[_pixels.Picture], Any], size: Any = None) -> Any:
        try:
            shown = _pixels.picture(*shape, data)
            _pixels.check(shown, operation, size)
            return call(shown)
        except _pixels.RangeError as error:
            return ["out-of-range", str(error)]
        except _pixels.ImageError as error:
            return ["not-a-frame", str(error).split("; supported are")[0]]

    def histogram(shown: _pixels.Picture, roi: Any) -> Iterator[Tuple[int, int]]:
        return (
            (level, int(count))
            for level, count in enumerate(_pixels.histogram(shown, roi))
            if count
        )

    def made(shown: _pixels.Picture) -> List[Any]:
        return [shown.encoding, shown.data.tobytes().hex()]

    return {
        "mean luma": lambda roi: outcome("mean luma", lambda shown: _pixels.mean_luma(shown, roi)),
        "histogram": lambda roi: outcome("histogram", lambda shown: list(histogram(shown, roi))),
        "to gray": lambda: outcome("grey image", lambda shown: made(_pixels.to_gray(shown))),
        "resize": lambda *size: outcome(
            "resize", lambda shown: made(_pixels.resize(shown, *size)), size
        ),
    }
