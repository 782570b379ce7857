"""What a lambda prints becomes lines of its log, as in WebAssembly: ``info`` from standard output, ``warn`` from standard
error. Only ``sys.stdout`` and ``sys.stderr`` lead here: other processes, and code that is not Python, go past it."""

from __future__ import annotations

import io
import os
import sys
import threading
from typing import Any, Callable, Optional

from .log import Level

Log = Callable[[Level, str], None]

# A line of the log holds as many. What is longer becomes several lines.
LINE_BYTES = 4096

STDERR = 2


class Lines(io.RawIOBase):
    """Gives what is written to a log, line by line; while there is none, to standard error, as it comes."""

    def __init__(self, name: str, level: Level) -> None:
        self.name = name
        self._level = level
        self._log: Optional[Log] = None
        self._begun = b""
        # Entered twice by one thread if an object that goes away in the midst of it prints its farewell.
        self._lock = threading.RLock()

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        """For those who write past Python, such as faulthandler, or processes that inherit the stream."""
        return STDERR

    def write(self, data: Any) -> int:
        data = bytes(data)
        with self._lock:
            if self._log is None:
                return os.write(STDERR, data)
            *lines, rest = (self._begun + data).split(b"\n")
            whole = len(rest) - len(rest) % LINE_BYTES
            self._begun = rest[whole:]
            for line in [*lines, rest[:whole]]:
                self._tell(line)
        return len(data)

    def end_line(self) -> None:
        """Writes down what did not end with a newline."""
        if self._begun:
            with self._lock:
                line, self._begun = self._begun, b""
                self._tell(line)

    def lead_to(self, log: Optional[Log]) -> None:
        with self._lock:
            self.end_line()
            self._log = log

    def forked(self) -> None:
        """In the child of a fork: nobody there reads the log, and the lock may be that of a thread which is not there."""
        self._lock, self._log, self._begun = threading.RLock(), None, b""

    def _tell(self, line: bytes) -> None:
        assert self._log is not None, "a line is begun only where there is a log"
        for at in range(0, len(line), LINE_BYTES):
            text = line[at : at + LINE_BYTES].decode(errors="replace").rstrip()
            if text:
                self._log(self._level, text)


class Stream:
    """What ``sys.stdout`` or ``sys.stderr`` is for a lambda, and the lines below it."""

    def __init__(self, name: str, level: Level) -> None:
        self.name, self.level = name, level
        self.make()

    def make(self) -> None:
        self.lines = Lines(self.name, self.level)
        self.text = io.TextIOWrapper(
            self.lines, encoding="utf-8", errors="backslashreplace", line_buffering=True
        )

    def is_whole(self) -> bool:
        """Whether no lambda closed it, or put a stream of its own on what is below."""
        try:
            return not self.text.closed
        except ValueError:
            return False


# They outlive a lambda: `logging`, for one, keeps the stream that it was set up with.
_streams = (Stream("<stdout>", "info"), Stream("<stderr>", "warn"))


def print_to(log: Optional[Log]) -> None:
    """From now on ``sys.stdout`` and ``sys.stderr`` lead to ``log``; with None to standard error."""
    end_call()
    for stream in _streams:
        if not stream.is_whole():
            stream.lines.lead_to(None)
            stream.make()
        stream.lines.lead_to(log)
    sys.stdout, sys.stderr = (stream.text for stream in _streams)


def end_call() -> None:
    """Writes down what has been printed, the beginnings of lines included."""
    for stream in _streams:
        if stream.is_whole():
            stream.text.flush()
        stream.lines.end_line()


def _forked() -> None:
    for stream in _streams:
        stream.lines.forked()


os.register_at_fork(after_in_child=_forked)
