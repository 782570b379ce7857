"""The part of hosting that is written in Python: finding a lambda in its file, telling its exceptions, taking down what it
prints, and keeping the garbage collector out of its wakes. `_gleaner` calls it, and so does `gleaner.testing`; no lambda imports it."""

from __future__ import annotations

import gc
import importlib.util
import os
import re
import site
import sys
import traceback
from types import ModuleType, TracebackType
from typing import Any, Callable, Dict, List, Optional, Tuple

from . import _deadline
from ._printed import end_call, print_to
from .context import Context
from .error import DeadlineExceeded

__all__ = [
    "attempt",
    "enter_environment",
    "load",
    "maker",
    "numpy_version",
    "own_modules",
    "print_to",
    "settle",
    "tidy",
]

Handler = Callable[..., object]

# A message has room for about so many entries of a traceback. Without a bound an endless recursion, a thousand entries
# deep, would take 16 ms to tell.
TRACE_ENTRIES = 40

# Code of this package, which is not what a lambda's author wants to see.
OURS = os.path.dirname(__file__) + os.sep

# What the environment has for its start was run.
_entered = False

HANDLERS: Dict[str, str] = {"on_event": "on_event(ctx, event)", "on_tick": "on_tick(ctx)"}


class LambdaError(Exception):
    """A file in which there is no lambda for its schedule. The text is for its author, who needs no traceback."""


def enter_environment() -> None:
    """Runs what the environment of this interpreter has for its start, and imports numpy: in the middle of a wake that would cost its
    deadline. By now the process is shut.

    Raises LambdaError, and whatever the environment raises."""
    global _entered
    if sys.flags.no_site and not _entered:
        site.main()
    _entered = True
    try:
        import numpy  # noqa: F401
    except ImportError as error:
        way_out = (
            f"{sys.executable} -m pip install numpy, or name another interpreter: GLEANER_PYTHON"
        )
        raise LambdaError(f"{error}; {way_out}") from None


def numpy_version() -> str:
    """That of the environment, by the names of what lies there: its code may not run yet."""
    if "numpy" in sys.modules:
        return str(sys.modules["numpy"].__version__)
    # Without `site` this interpreter does not know that it is one of an environment.
    own = os.path.dirname(os.path.dirname(os.path.abspath(sys.executable)))
    # Debian's says where the system's packages lie, and not those of an environment.
    python = "python{}.{}".format(*sys.version_info)
    folders = [
        os.path.join(own, "lib", python, "site-packages"),
        *site.getsitepackages([own, sys.base_prefix]),
    ]
    for folder in filter(os.path.isdir, folders):
        for name in sorted(os.listdir(folder)):
            found = re.match(r"numpy-([^-]+?)(?:-py[\d.]+)?\.(?:dist|egg)-info", name)
            if found:
                return found.group(1)
    return "unknown"


def load(entry: str, handler: str) -> Callable[[Context], Handler]:
    """Imports the file ``entry``; returns what makes a fresh lambda and gives its ``handler``: ``on_event`` or ``on_tick``.

    Raises LambdaError, and whatever the file raises."""
    return maker(_import(entry), handler, os.path.basename(entry))


def maker(found: Any, handler: str, where: str) -> Callable[[Context], Handler]:
    """As `load`, of what is imported already: a module, or the class of a lambda. ``where`` is its name.

    Raises LambdaError."""
    lambda_class = getattr(found, "Lambda", None) if isinstance(found, ModuleType) else found
    owner: Any = found if lambda_class is None else lambda_class
    if not callable(getattr(owner, handler, None)):
        raise LambdaError(_missing(owner, where, handler))

    def make(ctx: Context) -> Handler:
        if lambda_class is None:
            getattr(found, "init", _nothing)(ctx)
            made: Any = found
        else:
            made = lambda_class(ctx)
        bound: Handler = getattr(made, handler)
        return bound

    return make


def _nothing(ctx: Context) -> None:
    """What a module without ``init`` does."""


def _import(entry: str) -> ModuleType:
    folder = os.path.dirname(entry)
    # A replay that is repeated begins with fresh globals, those of the lambda's own modules included.
    for name in own_modules(folder):
        del sys.modules[name]
    # As for any script, what lies beside the file can be imported, and is found before what lies elsewhere.
    if sys.path[:1] != [folder]:
        sys.path.insert(0, folder)
    # A build folder is what was built, and nothing else.
    sys.dont_write_bytecode = True
    spec = importlib.util.spec_from_file_location("main", entry)
    if spec is None or spec.loader is None:
        raise LambdaError(
            f"`{os.path.basename(entry)}` is no Python file: its name must end with `.py`"
        )
    module = importlib.util.module_from_spec(spec)
    sys.modules["main"] = module
    spec.loader.exec_module(module)
    return module


def own_modules(folder: str) -> List[str]:
    """Names of the imported modules that are the lambda's own: that lie below its folder, also by way of links.

    An environment or an SDK that lies there, or what is hidden, is no part of the lambda."""
    names: Dict[str, List[str]] = {}
    for name, known in list(sys.modules.items()):
        names.setdefault(_place(known), []).append(name)
    return [name for place, there in names.items() if _is_own(folder, place) for name in there]


def _place(module: object) -> str:
    """The folder in which a module lies; of a package without a file, its own."""
    about: Dict[str, Any] = getattr(module, "__dict__", {})
    file = about.get("__file__")
    try:
        return os.path.abspath(
            str(os.path.dirname(file) if file else next(iter(about.get("__path__", ()))))
        )
    except (KeyError, StopIteration, TypeError):
        # Built in; or a package whose parent is gone.
        return ""


def _is_own(folder: str, place: str) -> bool:
    if not place or os.path.join(place, "").startswith((OURS, os.path.join(sys.prefix, ""))):
        return False
    for form in (os.path.abspath, os.path.realpath):
        root = os.path.join(form(folder), "")
        inside = os.path.join(form(place), "")
        if inside.startswith(root):
            return not any(part.startswith(".") for part in inside[len(root) :].split(os.sep))
    return False


def _missing(owner: Any, where: str, handler: str) -> str:
    where, wanted = f"`{where}`", HANDLERS[handler]
    if not isinstance(owner, ModuleType):
        where, wanted = f"`Lambda` of {where}", wanted.replace("(", "(self, ")
    schedule = "event" if handler == "on_event" else "period"
    found = " and ".join(f"`{name}`" for name in HANDLERS if callable(getattr(owner, name, None)))
    return f"{where} has no `{wanted}`, which `{schedule}` in [schedule] asks for; found {found or 'no handler'}"


def attempt(
    seconds: float, call: Callable[..., object], *arguments: object
) -> Tuple[object, Optional[str], str]:
    """What ``call`` returns, or the text of what it raises and of which kind that is: even of what asks to leave the process, and
    of a panic in the host's own code, which comes as an exception, too. After so many seconds it raises DeadlineExceeded; 0 is
    for ever."""
    try:
        return _attempt(seconds, call, *arguments)
    except DeadlineExceeded as late:
        # It came once more, on the way out.
        _deadline.disarm()
        return None, explain(late), "deadline"
    finally:
        end_call()


def _attempt(
    seconds: float, call: Callable[..., object], *arguments: object
) -> Tuple[object, Optional[str], str]:
    try:
        _deadline.arm(seconds)
        result = call(*arguments)
        if _deadline.disarm():
            return None, "the lambda caught DeadlineExceeded, and went on", "deadline"
        return result, None, ""
    except BaseException as error:
        _deadline.disarm()
        return None, explain(error), _kind(error)


def _kind(error: BaseException) -> str:
    if isinstance(error, DeadlineExceeded):
        return "deadline"
    return "memory" if isinstance(error, MemoryError) else "exception"


def explain(error: BaseException) -> str:
    """The traceback of an exception: the last entries, and none of ours."""
    if isinstance(error, LambdaError):
        return str(error)
    trace = error.__traceback__
    while trace is not None and _is_ours(trace):
        trace = trace.tb_next
    lines = traceback.format_exception(type(error), error, trace, limit=-TRACE_ENTRIES)
    return "".join(lines).rstrip()


def _is_ours(trace: TracebackType) -> bool:
    file = trace.tb_frame.f_code.co_filename
    return file.startswith((OURS, "<frozen importlib"))


def settle() -> None:
    """Puts all that lives now out of the collector's sight and switches it off; from then on `tidy` calls it.

    Most of what a process holds are the modules it imported. Looking through them takes tens of milliseconds, and the
    collector would do that in the middle of a wake. The price: cycles of what lives now are not collected before the next
    call, so if the first lambda of a process is one and faults, it stays, and its successors do not."""
    gc.unfreeze()
    gc.collect()
    gc.freeze()
    gc.disable()


def tidy(wakes: int) -> None:
    """Collects between two wakes, the young objects often and all of them seldom: a cycle that holds a frame holds a slot."""
    if wakes % 1000 == 0:
        gc.collect()
    elif wakes % 100 == 0:
        gc.collect(1)
    else:
        gc.collect(0)
