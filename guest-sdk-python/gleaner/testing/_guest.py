"""The lambda itself: found as it was given, made, called, and made anew after a fault. What it raises is told by the part of
the SDK that tells it in the host."""

from __future__ import annotations

import contextlib
import inspect
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, Callable, Iterator, List, Optional, Tuple, Union

from .. import _host
from ._context import Context, set_missed
from ._data import Source, sample
from ._error import ReplayError, StartError
from ._manifest import Manifest
from ._ring import Cell
from ._schedule import Tick
from ._session import LINE_BYTES, Scratch, Session

Given = Union[type, ModuleType, str, "os.PathLike[str]"]
Wake = Union[Tick, Tuple[Source, Cell]]


class Fault:
    """Why a wake ended early."""

    def __init__(self, kind: str, message: str, allowed: Optional[int]) -> None:
        self.kind, self.message, self.allowed = kind, message, allowed


class Guest:
    """One lambda over one session."""

    def __init__(
        self, given: Given, manifest: Manifest, session: Session, sources: List[Source]
    ) -> None:
        self._given, self._manifest, self._session, self._sources = (
            given,
            manifest,
            session,
            sources,
        )
        self._scratch = Scratch(session.limits)
        self._make: Optional[Callable[[Context], Callable[..., object]]] = None
        self._live: Optional[Tuple[Context, Callable[..., object]]] = None
        self._raised: Optional[BaseException] = None

    def init(self) -> None:
        """Raises StartError if the lambda does."""
        fault = self._start()
        if fault is not None:
            raised, self._raised = self._raised, None
            raise StartError(
                f"cannot start lambda `{self._manifest.name}`", fault.message, fault.kind
            ) from raised

    def wake(self, wake: Wake) -> Optional[Fault]:
        if self._live is None:
            caused = self._session.suspend()
            fault = self._start()
            self._session.resume(caused)
            if fault is not None:
                return fault
        assert self._live is not None, "it has just been made"
        # Taken away, so that a lambda that faults is gone.
        (context, handler), self._live = self._live, None
        if isinstance(wake, Tick):
            set_missed(context, wake.missed)
            _, fault = self._attempt("", handler, context)
        else:
            source, cell = wake
            _, fault = self._attempt(
                "", handler, context, sample(context.input(source.declared.name), cell)
            )
        if fault is None:
            self._live = context, handler
        return fault

    def _start(self) -> Optional[Fault]:
        if self._make is None:
            make, fault = self._attempt("in import: ", self._load)
            if fault is not None:
                return fault
            self._make = make
        context = Context(self._session, self._sources, self._manifest.config, self._scratch)
        handler, fault = self._attempt("in init: ", self._make, context)
        if fault is None:
            self._live = context, handler
        return fault

    def _load(self) -> Any:
        if isinstance(self._given, (str, os.PathLike)):
            return _host.load(
                str(folder(self._given).resolve() / self._manifest.entry), self._manifest.handler
            )
        return _host.maker(self._given, self._manifest.handler, _name(self._given))

    def _attempt(self, when: str, call: Any, *arguments: Any) -> Tuple[Any, Optional[Fault]]:
        """Calls code of the lambda. Ctrl-C ends the replay; everything else that is raised is a fault."""
        stopped = None

        def called(*arguments: Any) -> Any:
            nonlocal stopped
            try:
                return call(*arguments)
            except KeyboardInterrupt as error:
                stopped = error
                raise
            except BaseException as error:
                # A traceback holds the frames of a call, and these the sample: only what ends the replay is kept.
                self._raised = error if when else None
                raise

        result, told, kind = _host.attempt(0, called, *arguments)
        if stopped is not None:
            raise stopped
        if told is None:
            return result, None
        allowed = self._manifest.limits["memory"] if kind == "memory" else None
        return None, Fault(kind, when + _ending(told, LINE_BYTES - len(when)), allowed)


def _ending(text: str, most: int) -> str:
    """A traceback says what happened last."""
    return text.encode(errors="replace")[-most:].decode(errors="ignore")


def _name(given: Any) -> str:
    """Where a class or a module comes from."""
    return str(getattr(given, "__module__", None) or getattr(given, "__name__", "lambda"))


def folder(given: Union[str, "os.PathLike[str]"]) -> Path:
    """Where a lambda lies that was given by its folder, its entry or its manifest."""
    path = Path(given)
    if not path.exists():
        raise ReplayError(
            f"there is no lambda `{path}`", help="give its class, its module, or its folder"
        )
    return path if path.is_dir() else path.parent


def home(given: Given) -> Optional[Path]:
    """Where a lambda lies, if it lies anywhere: a class of a notebook does not. Raises ReplayError."""
    if isinstance(given, (str, os.PathLike)):
        return folder(given)
    try:
        return Path(inspect.getfile(given)).parent
    except (TypeError, OSError):
        return None


def manifest_beside(given: Given) -> Path:
    """The manifest that lies where the lambda does. Raises ReplayError."""
    if isinstance(given, (str, os.PathLike)):
        return folder(given) / "lambda.toml"
    beside = home(given)
    if beside is None or not (beside / "lambda.toml").is_file():
        raise ReplayError(
            f"no manifest lies beside `{_name(given)}`",
            help='pass manifest="path/to/lambda.toml", or a dict',
        )
    return beside / "lambda.toml"


@contextlib.contextmanager
def guarded(log: Optional[Callable[[Any, str], None]], given: Given) -> Iterator[None]:
    """While it lasts, what is printed goes to ``log``, if there is one; afterwards the interpreter is as it was, and knows nothing
    of what was imported from the folder of the lambda that was ``given``."""
    streams, path, writes = (sys.stdout, sys.stderr), list(sys.path), sys.dont_write_bytecode
    modules = dict(sys.modules)
    if log is not None:
        _host.print_to(log)
    try:
        yield
    finally:
        if log is not None:
            _host.print_to(None)
            sys.stdout, sys.stderr = streams
        sys.path[:], sys.dont_write_bytecode = path, writes
        if "main" not in modules:
            sys.modules.pop("main", None)
        if isinstance(given, (str, os.PathLike)):
            # Another lambda may have modules of the same names.
            for name in _host.own_modules(str(folder(given))):
                del sys.modules[name]
        # Fresh globals for a lambda must not mean that a test beside it is gone.
        sys.modules.update(modules)
