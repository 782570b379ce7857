"""Loads and calls a lambda, and creates a fresh instance after a fault. `gleaner._host` formats its
exceptions, as in the host."""

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
from ._data import InputState, sample
from ._error import ReplayError, StartError, TestFailed
from ._manifest import Manifest
from ._ring import Cell
from ._schedule import Tick
from ._session import LINE_BYTES, Scratch, Session

LambdaSource = Union[type, ModuleType, str, "os.PathLike[str]"]
Wake = Union[Tick, Tuple[InputState, Cell]]


class Fault:
    """An error that ended a wake early."""

    def __init__(self, kind: str, message: str, allowed: Optional[int]) -> None:
        self.kind, self.message, self.allowed = kind, message, allowed


class Guest:
    """One lambda over one session."""

    def __init__(
        self, given: LambdaSource, manifest: Manifest, session: Session, sources: List[InputState]
    ) -> None:
        self._given, self._manifest = given, manifest
        self._session, self._sources = session, sources
        self._scratch = Scratch(session.limits)
        self._create: Optional[Callable[[Context], Callable[..., object]]] = None
        self._instance: Optional[Tuple[Context, Callable[..., object]]] = None
        self._raised: Optional[BaseException] = None

    def init(self) -> None:
        """Loads and initialises the lambda. Raises StartError if it raises."""
        fault = self._start()
        if fault is not None:
            raised, self._raised = self._raised, None
            raise StartError(
                f"cannot start lambda `{self._manifest.name}`", fault.message, fault.kind
            ) from raised

    def wake(self, wake: Wake) -> Optional[Fault]:
        if self._instance is None:
            caused = self._session.suspend()
            fault = self._start()
            self._session.resume(caused)
            if fault is not None:
                return fault
        assert self._instance is not None, "it has just been created"
        # Removed first, so that the instance is dropped if it faults.
        (context, handler), self._instance = self._instance, None
        if isinstance(wake, Tick):
            set_missed(context, wake.missed)
            _, fault = self._attempt("", handler, context)
        else:
            source, cell = wake
            _, fault = self._attempt(
                "", handler, context, sample(context.input(source.declared.name), cell)
            )
        if fault is None:
            self._instance = context, handler
        return fault

    def _start(self) -> Optional[Fault]:
        if self._create is None:
            make, fault = self._attempt("in import: ", self._load)
            if fault is not None:
                return fault
            self._create = make
        context = Context(self._session, self._sources, self._manifest.config, self._scratch)
        handler, fault = self._attempt("in init: ", self._create, context)
        if fault is None:
            self._instance = context, handler
        return fault

    def _load(self) -> Any:
        if isinstance(self._given, (str, os.PathLike)):
            return _host.load(
                str(folder(self._given).resolve() / self._manifest.entry), self._manifest.handler
            )
        return _host.maker(self._given, self._manifest.handler, _name(self._given))

    def _attempt(self, when: str, call: Any, *arguments: Any) -> Tuple[Any, Optional[Fault]]:
        """Calls code of the lambda. Ctrl-C and errors of the test end the replay; every other
        exception is a fault."""
        stopped: Optional[BaseException] = None

        def called(*arguments: Any) -> Any:
            nonlocal stopped
            try:
                return call(*arguments)
            except KeyboardInterrupt as error:
                stopped = error
                raise
            except TestFailed as error:
                stopped = error.__cause__
                raise
            except BaseException as error:
                # A traceback keeps the stack frames of a call, which keep the sample. Keep only the
                # exception that ends the replay.
                self._raised = error if when else None
                raise

        result, text, kind = _host.attempt(0, called, *arguments)
        if stopped is not None:
            raise stopped
        if text is None:
            return result, None
        allowed = self._manifest.limits["memory"] if kind == "memory" else None
        return None, Fault(kind, when + _ending(text, LINE_BYTES - len(when)), allowed)


def _ending(text: str, most: int) -> str:
    """Returns the end of a text, at most ``most`` bytes: a traceback ends with the exception."""
    return text.encode(errors="replace")[-most:].decode(errors="ignore")


def _name(given: Any) -> str:
    """Returns the name of the module of a class, or of the module."""
    return str(getattr(given, "__module__", None) or getattr(given, "__name__", "lambda"))


def folder(given: Union[str, "os.PathLike[str]"]) -> Path:
    """Returns the folder of a lambda, from the path of its folder, entry or manifest."""
    path = Path(given)
    if not path.exists():
        raise ReplayError(
            f"there is no lambda `{path}`", help="pass its class, its module, or its folder"
        )
    return path if path.is_dir() else path.parent


def home(given: LambdaSource) -> Optional[Path]:
    """Returns the folder of a lambda; None if it has no file, such as a class in a notebook. Raises
    ReplayError."""
    if isinstance(given, (str, os.PathLike)):
        return folder(given)
    try:
        return Path(inspect.getfile(given)).parent
    except (TypeError, OSError):
        return None


def manifest_beside(given: LambdaSource) -> Path:
    """Returns the path of the manifest in the folder of the lambda. Raises ReplayError."""
    if isinstance(given, (str, os.PathLike)):
        return folder(given) / "lambda.toml"
    beside = home(given)
    if beside is None or not (beside / "lambda.toml").is_file():
        raise ReplayError(
            f"there is no manifest beside `{_name(given)}`",
            help='pass manifest="path/to/lambda.toml", or a dict',
        )
    return beside / "lambda.toml"


@contextlib.contextmanager
def guarded(log: Optional[Callable[[Any, str], None]], given: LambdaSource) -> Iterator[None]:
    """Redirects printed text to ``log``, if there is one. On exit restores the interpreter, and
    removes the modules that were imported from the folder of the lambda ``given``."""
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
            # Another lambda may have modules with the same names.
            for name in _host.own_modules(str(folder(given))):
                del sys.modules[name]
        # Keep the modules of tests in the same folder.
        sys.modules.update(modules)
