"""Replays a drive: delivers every sample and runs every wake of the schedule. Time is that of the
drive."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any, Dict, List, Mapping, Optional, Sequence, Tuple, Union

from . import _manifest
from ._arrays import Arrays
from ._data import InputState
from ._drive import Drive, Name
from ._error import ReplayError, quoted
from ._frame import Budget, FramePool
from ._guest import LambdaSource, Guest, Wake, guarded, home, manifest_beside
from ._inference import FakeModel, ModelTable, available
from ._manifest import Manifest
from ._run import Decision, Fault, Run
from ._schedule import Event, Periodic, Schedule, Tick
from ._session import Session
from ._types import Definitions
from ._windows import Trigger, windows

FAULTS_IN_A_ROW = 8
MIN_BACKOFF_NS, MAX_BACKOFF_NS = 100_000_000, 10_000_000_000

REINITIALISED = (
    "gleaner: the lambda was re-initialised after a fault: its variables are lost "
    "(in Python, all but the globals of its module)"
)
BACKING_OFF = (
    "gleaner: the lambda faulted 8 times in a row: wakes are skipped and counted, for 100 ms "
    "and twice as long after each further fault, at most 10 s, until a wake succeeds"
)

Tables = Mapping[str, Mapping[str, Any]]


def replay(
    lambda_: LambdaSource,
    drive: Union[Name, Sequence[Name], Drive, Tables],
    *,
    manifest: Optional[_manifest.ManifestSource] = None,
    config: Optional[Mapping[str, Any]] = None,
    remap: Optional[Mapping[str, str]] = None,
    types: Optional[Mapping[str, str]] = None,
    models: Optional[Mapping[str, FakeModel]] = None,
    prints_to_log: bool = True,
) -> Run:
    """Runs a lambda over a drive, as ``gleaner replay`` does, and returns its decisions.

    ``lambda_`` is the class, module or folder of the lambda. ``manifest`` is the path of its
    ``lambda.toml`` or a dict with the same content; the default is the file in the folder of the
    lambda. ``drive`` is the path of an MCAP file or a rosbag2 directory, a list of them, a
    :class:`Drive`, or arrays by topic::

        replay(Lambda, {"/imu/data": {"t": seconds, "linear_acceleration.z": az}})

    ``config`` overrides values of ``[config]``. ``remap`` maps topics of the manifest to topics of
    the drive. ``types`` maps type names to texts of ``.msg`` files, for types that are neither in
    the drive, nor in the folder ``msg/`` of the lambda, nor in ROS 2. ``models`` has the answers of
    each ``[[model]]`` that the lambda opens. Text that the lambda prints goes to its log; with
    ``prints_to_log=False``, for example in a debugger, it goes to standard output.

    Raises ReplayError if an argument cannot be used, or the answer of a model is wrong, and
    StartError if the lambda's import or ``init`` raises. An exception in a wake is a fault in its
    decision. Ctrl-C ends the replay."""
    source = manifest if manifest is not None else manifest_beside(lambda_)
    read = _manifest.read(source, config or {})
    if isinstance(lambda_, (str, os.PathLike)) and read.kind != "python":
        raise ReplayError(
            f"lambda `{lambda_}` is of kind `{read.kind}`",
            help="only Python lambdas run here; use gleaner replay",
        )
    beside = home(lambda_) if isinstance(source, Mapping) else Path(source).parent
    more = Definitions(types or {}, None if beside is None else beside / "msg")
    table = ModelTable(read.models, models or {}, read.limits)
    return _ReplayLoop(lambda_, read, drive, dict(remap or {}), more, table).run(prints_to_log)


class _ReplayLoop:
    """The event loop of one replay."""

    def __init__(
        self,
        given: LambdaSource,
        manifest: Manifest,
        drive: Any,
        remap: Dict[str, str],
        more: Definitions,
        models: ModelTable,
    ) -> None:
        self._models = models
        self._given, self._manifest, self._session = given, manifest, Session(manifest.limits)
        _check_remap(remap, manifest)
        names = {one.topic: remap.get(one.topic, one.topic) for one in manifest.inputs}
        self._drive = _drive(drive, manifest, names, more)
        self._sources = self._inputs(names, more)
        # In the order of the manifest; two inputs may be one topic of the drive.
        self._by_topic: Dict[str, List[InputState]] = {}
        for source in self._sources:
            self._by_topic.setdefault(names[source.declared.topic], []).append(source)
        _check_recorded(self._drive, manifest, remap)
        self._guest = Guest(given, manifest, self._session, self._sources)
        woken_by = [source for source in self._sources if source.declared.name == manifest.event]
        self._schedule: Schedule = Event(woken_by[0]) if woken_by else Periodic(manifest.period_ns)
        self._decisions: List[Decision] = []
        self._in_a_row, self._backoff_ns = 0, 0
        self._backoff: Tuple[int, int] = (0, 0)

    def _inputs(self, names: Mapping[str, str], more: Definitions) -> List[InputState]:
        drive, inputs, limits = self._drive, self._manifest.inputs, self._manifest.limits
        for declared in inputs:
            found = drive.type_of(names[declared.topic])
            if found != declared.type_name:
                cause = f"topic `{names[declared.topic]}` is of type `{found}`"
                raise ReplayError(
                    f"input `{declared.name}` is of type `{declared.type_name}`", cause
                )
        budget = Budget(limits)
        return [
            InputState(
                declared,
                drive.types(names[declared.topic], more),
                limits,
                FramePool(declared, budget),
            )
            for declared in inputs
        ]

    def run(self, prints_to_log: bool) -> Run:
        log = self._session.log if prints_to_log else None
        with guarded(log, self._given), available(self._models):
            self._guest.init()
            self._run_loop()
        session, drive = self._session, self._drive
        triggers = [trigger for decision in self._decisions for trigger in decision.triggers]
        return Run(
            decisions=self._decisions,
            log=session.lines,
            counts={source.declared.name: source.counts() for source in self._sources},
            start_ns=drive.start_ns,
            end_ns=drive.end_ns,
            log_dropped=session.log_dropped,
            triggers_refused=session.triggers_refused,
            backed_off=session.backed_off,
            missed_ticks=self._schedule.missed_total,
            windows=windows(self._manifest.record, triggers, drive.start_ns, drive.end_ns),
        )

    def _run_loop(self) -> None:
        self._schedule.begin(self._drive.begins_ns)
        for topic, arrival in self._drive.deliveries(set(self._by_topic)):
            self._ticks(arrival.at_ns)
            for source in self._by_topic.get(topic, []):
                source.ring.push(arrival)
                for wake in self._schedule.events():
                    self._wake(wake[1].arrival.at_ns, wake)
        # A tick at the last instant is still due.
        self._ticks(self._drive.end_ns + 1)

    def _ticks(self, now_ns: int) -> None:
        for tick in self._schedule.ticks(now_ns):
            self._wake(tick.at_ns, tick)

    def _wake(self, at_ns: int, wake: Wake) -> None:
        """Runs one wake and adds its decision. Triggers before a fault still count."""
        session = self._session
        if self._backoff[0] <= at_ns < self._backoff[1]:
            session.backed_off += 1
            return
        session.begin(at_ns)
        if self._in_a_row > 0:
            session.note(REINITIALISED)
        started = time.perf_counter_ns()
        fault = self._guest.wake(wake)
        run_ns = time.perf_counter_ns() - started
        at_s = (at_ns - self._drive.start_ns) / 1e9
        triggers = [
            Trigger(at_s, at_ns, it.kind, it.label, it.score, it.attributes) for it in session.end()
        ]
        shown = None
        if fault is not None:
            shown = Fault(fault.kind, fault.message, None, fault.allowed)
        decision = Decision(
            at_ns=at_ns, **_cause(wake), triggers=triggers, fault=shown, run_ns=run_ns
        )
        self._decisions.append(decision)
        self._count(at_ns, fault is not None)

    def _count(self, at_ns: int, faulted: bool) -> None:
        """Starts back-off after ``FAULTS_IN_A_ROW`` faults; each further one doubles it."""
        if not faulted:
            self._in_a_row, self._backoff_ns, self._backoff = 0, 0, (0, 0)
            return
        self._in_a_row += 1
        if self._in_a_row >= FAULTS_IN_A_ROW:
            doubled_ns = max(2 * self._backoff_ns, MIN_BACKOFF_NS)
            self._backoff_ns = min(doubled_ns, MAX_BACKOFF_NS)
            self._backoff = (at_ns, at_ns + self._backoff_ns)
        if self._in_a_row == FAULTS_IN_A_ROW:
            self._session.note(BACKING_OFF)


def _cause(wake: Wake) -> Dict[str, Any]:
    if isinstance(wake, Tick):
        return {"cause": "tick", "input": None, "topic": None, "writer": None, "seq": None}
    source, cell = wake
    arrival, declared = cell.arrival, source.declared
    woken_by = {"writer": str(arrival.writer), "seq": arrival.seq}
    return {"cause": "event", "input": declared.name, "topic": declared.topic, **woken_by}


def _check_remap(remap: Mapping[str, str], manifest: Manifest) -> None:
    known = {one.topic: None for one in manifest.inputs}
    known.update(dict.fromkeys(manifest.record.topics if manifest.record is not None else []))
    for topic in remap:
        if topic not in known:
            raise ReplayError(
                f"no input has the topic `{topic}` of remap",
                help=f"the manifest has {quoted(known)}",
            )


def _check_recorded(
    drive: Union[Drive, Arrays], manifest: Manifest, remap: Mapping[str, str]
) -> None:
    """Raises ReplayError if the drive has no topic of `[record]`. Some of them may be missing."""
    if manifest.record is None or drive.is_partial:
        return
    topics = [remap.get(topic, topic) for topic in manifest.record.topics]
    if not any(topic in drive.topics for topic in topics):
        help = (
            f"the drive has {quoted(drive.topics)}; pass remap={{FROM: TO}}, or a manifest "
            "without [record]"
        )
        raise ReplayError(
            "the drive has none of the topics of [record]", f"[record] has {quoted(topics)}", help
        )


def _drive(
    given: Any, manifest: Manifest, names: Mapping[str, str], more: Definitions
) -> Union[Drive, Arrays]:
    if isinstance(given, Drive):
        return given
    if not isinstance(given, Mapping):
        return Drive(given)
    type_names = {names[one.topic]: one.type_name for one in manifest.inputs}
    woken_by = next(
        (names[one.topic] for one in manifest.inputs if one.name == manifest.event), None
    )
    if woken_by is not None and woken_by not in given:
        cause = f"there are arrays of {quoted(given)}, and `{woken_by}` wakes the lambda"
        raise ReplayError("nothing would wake the lambda", cause, "pass arrays of that topic")
    return Arrays(given, more, type_names)
