"""Logs the text that a lambda prints, as in WebAssembly: ``info`` from standard output, ``warn``
from standard error. Only ``sys.stdout`` and ``sys.stderr`` are redirected: output of other
processes and of code that is not Python is not logged."""

from __future__ import annotations

import io
import os
import sys
import threading
from typing import Any, Callable, Optional

from .log import Level

Log = Callable[[Level, str], None]

# Maximum length of a log line. A longer text becomes several lines.
LINE_BYTES = 4096

STDERR = 2


class LogWriter(io.RawIOBase):
    """Writes text to a log, line by line; without a log, to standard error, unchanged."""

    def __init__(self, name: str, level: Level) -> None:
        self.name = name
        self._level = level
        self._log: Optional[Log] = None
        self._pending = b""
        # Reentrant: an object that is deleted during a write may print in its `__del__`.
        self._lock = threading.RLock()

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        """Returns the file descriptor for writers outside of Python, such as faulthandler and child
        processes."""
        return STDERR

    def write(self, data: Any) -> int:
        data = bytes(data)
        with self._lock:
            if self._log is None:
                return os.write(STDERR, data)
            *lines, rest = (self._pending + data).split(b"\n")
            whole = len(rest) - len(rest) % LINE_BYTES
            self._pending = rest[whole:]
            for line in [*lines, rest[:whole]]:
                self._write_line(line)
        return len(data)

    def end_line(self) -> None:
        """Writes a pending line that has no newline."""
        if self._pending:
            with self._lock:
                line, self._pending = self._pending, b""
                self._write_line(line)

    def set_log(self, log: Optional[Log]) -> None:
        with self._lock:
            self.end_line()
            self._log = log

    def forked(self) -> None:
        """Resets the state in the child of a fork: the child has no log, and the lock may be held
        by a thread that does not exist in the child."""
        self._lock, self._log, self._pending = threading.RLock(), None, b""

    def _write_line(self, line: bytes) -> None:
        assert self._log is not None, "a line is begun only where there is a log"
        for at in range(0, len(line), LINE_BYTES):
            text = line[at : at + LINE_BYTES].decode(errors="replace").rstrip()
            if text:
                self._log(self._level, text)


class Stream:
    """The ``sys.stdout`` or ``sys.stderr`` of a lambda, and the log writer below it."""

    def __init__(self, name: str, level: Level) -> None:
        self.name, self.level = name, level
        self.open()

    def open(self) -> None:
        self.writer = LogWriter(self.name, self.level)
        self.text = io.TextIOWrapper(
            self.writer, encoding="utf-8", errors="backslashreplace", line_buffering=True
        )

    def is_open(self) -> bool:
        """Returns whether the stream is open: no lambda has closed or detached it."""
        try:
            return not self.text.closed
        except ValueError:
            return False


# These streams are kept across instances of a lambda: `logging`, for example, keeps the stream with
# which it was configured.
_streams = (Stream("<stdout>", "info"), Stream("<stderr>", "warn"))


def print_to(log: Optional[Log]) -> None:
    """Redirects ``sys.stdout`` and ``sys.stderr`` to ``log``; with None, to standard error."""
    end_call()
    for stream in _streams:
        if not stream.is_open():
            stream.writer.set_log(None)
            stream.open()
        stream.writer.set_log(log)
    sys.stdout, sys.stderr = (stream.text for stream in _streams)


def end_call() -> None:
    """Writes all printed text to the log, including lines without a newline."""
    for stream in _streams:
        if stream.is_open():
            stream.text.flush()
        stream.writer.end_line()


def _forked() -> None:
    for stream in _streams:
        stream.writer.forked()


os.register_at_fork(after_in_child=_forked)
