"""The Python part of the host of a lambda. Loads the lambda from its file, formats its exceptions,
logs the text that it prints, and keeps the garbage collector out of its wakes. `_gleaner` and
`gleaner.testing` call it; no lambda imports it."""

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
from ._printed import end_call
from ._printed import print_to as print_to
from .context import Context
from .error import DeadlineExceeded

Handler = Callable[..., object]

# Maximum number of entries of a traceback: about as many fit into a message. Without a limit,
# formatting the traceback of an endless recursion, a thousand entries deep, would take 16 ms.
TRACE_ENTRIES = 40

# Folder of this package, whose code is left out of tracebacks.
SDK_FOLDER = os.path.dirname(__file__) + os.sep

# True once the start-up code of the environment has run.
_entered = False

HANDLERS: Dict[str, str] = {"on_event": "on_event(ctx, event)", "on_tick": "on_tick(ctx)"}


class LambdaError(Exception):
    """The file has no lambda for its schedule. The text is for the lambda's author, who needs no
    traceback."""


def enter_environment() -> None:
    """Runs the start-up code of this interpreter's environment and imports numpy, which would
    exceed the deadline in a wake. The process is sandboxed by now.

    Raises LambdaError, and any exception of the environment."""
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
    """Returns the version of the environment's numpy, read from its file names: its code must not
    run yet."""
    if "numpy" in sys.modules:
        return str(sys.modules["numpy"].__version__)
    # Without `site` this interpreter does not find its virtual environment.
    own = os.path.dirname(os.path.dirname(os.path.abspath(sys.executable)))
    # Debian's `getsitepackages` returns the folders of the system, not those of an environment.
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
    """Imports the file ``entry``. Returns a function that creates a lambda and returns its
    ``handler``: ``on_event`` or ``on_tick``.

    Raises LambdaError, and any exception of the file."""
    return maker(_import(entry), handler, os.path.basename(entry))


def maker(found: Any, handler: str, where: str) -> Callable[[Context], Handler]:
    """Returns the same as `load`, for an imported module or the class of a lambda. ``where`` is its
    name.

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
    """Replaces a missing ``init``."""


def _import(entry: str) -> ModuleType:
    folder = os.path.dirname(entry)
    # A repeated replay begins with fresh globals, also in the lambda's own modules.
    for name in own_modules(folder):
        del sys.modules[name]
    # As for any script, modules in the folder of the file are found first.
    if sys.path[:1] != [folder]:
        sys.path.insert(0, folder)
    # The build folder must not get any other files.
    sys.dont_write_bytecode = True
    spec = importlib.util.spec_from_file_location("main", entry)
    if spec is None or spec.loader is None:
        raise LambdaError(
            f"`{os.path.basename(entry)}` is not a Python file: its name must end with `.py`"
        )
    module = importlib.util.module_from_spec(spec)
    sys.modules["main"] = module
    spec.loader.exec_module(module)
    return module


def own_modules(folder: str) -> List[str]:
    """Returns the names of the imported modules that belong to the lambda: those below its folder,
    also through links.

    An environment or an SDK in the folder, and hidden folders, do not belong to the lambda."""
    names: Dict[str, List[str]] = {}
    for name, known in list(sys.modules.items()):
        names.setdefault(_place(known), []).append(name)
    return [name for place, there in names.items() if _is_own(folder, place) for name in there]


def _place(module: object) -> str:
    """Returns the folder of a module; for a package without a file, its own folder."""
    about: Dict[str, Any] = getattr(module, "__dict__", {})
    file = about.get("__file__")
    try:
        return os.path.abspath(
            str(os.path.dirname(file) if file else next(iter(about.get("__path__", ()))))
        )
    except (KeyError, StopIteration, TypeError):
        # A built-in module, or a package whose parent is no longer imported.
        return ""


def _is_own(folder: str, place: str) -> bool:
    if not place or os.path.join(place, "").startswith((SDK_FOLDER, os.path.join(sys.prefix, ""))):
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
    return (
        f"{where} has no `{wanted}`, which `{schedule}` in [schedule] requires; "
        f"found {found or 'no handler'}"
    )


def attempt(
    seconds: float, call: Callable[..., object], *arguments: object
) -> Tuple[object, Optional[str], str]:
    """Returns the result of ``call``, or the text and kind of its exception. Catches every
    exception, including those that end the process and those of panics in the host. Raises
    DeadlineExceeded in ``call`` after ``seconds``; 0 is no deadline."""
    try:
        return _attempt(seconds, call, *arguments)
    except DeadlineExceeded as late:
        # The exception was raised again while the first one was handled.
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
    """Returns the traceback of an exception: its last entries, without those of this package."""
    if isinstance(error, LambdaError):
        return str(error)
    trace = error.__traceback__
    while trace is not None and _is_sdk(trace):
        trace = trace.tb_next
    lines = traceback.format_exception(type(error), error, trace, limit=-TRACE_ENTRIES)
    return "".join(lines).rstrip()


def _is_sdk(trace: TracebackType) -> bool:
    file = trace.tb_frame.f_code.co_filename
    return file.startswith((SDK_FOLDER, "<frozen importlib"))


def settle() -> None:
    """Excludes all current objects from garbage collection and disables the collector; from then on
    `tidy` runs it.

    Most objects of a process belong to imported modules. Traversing them takes tens of
    milliseconds, and the collector would do so in the middle of a wake. The cost: cycles among the
    current objects are not collected before the next call. If the first lambda of a process is in a
    cycle and faults, it stays in memory; later ones do not."""
    gc.unfreeze()
    gc.collect()
    gc.freeze()
    gc.disable()


def tidy(wakes: int) -> None:
    """Runs the collector between two wakes, often for young objects and rarely for all: a cycle
    that holds a frame holds a slot."""
    if wakes % 1000 == 0:
        gc.collect()
    elif wakes % 100 == 0:
        gc.collect(1)
    else:
        gc.collect(0)
