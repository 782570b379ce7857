"""Runs this interpreter as the host of a Python lambda.

`gleaner-runtime` executes `python3 -I -S start.py LIB_GLEANER ARGUMENTS...`, with its own name and
arguments as ARGUMENTS. The module `_gleaner` is loaded from LIB_GLEANER, so it need not be
installed, and any virtual environment can be used. No code of the environment runs here: it is
untrusted like the lambda, and runs after the process is sandboxed, see `gleaner._host`.
"""

from __future__ import annotations

import importlib.util
import os
import signal
import sys
from importlib.machinery import ExtensionFileLoader
from types import ModuleType
from typing import NoReturn

INTERNAL = 1
USAGE = 2


def main() -> NoReturn:
    # Ctrl-C ends the process. As an exception it would be a fault of the current wake.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
    extension = load(sys.argv[1])
    import gleaner
    from gleaner import _host

    if gleaner.__version__ != extension.__version__:
        refuse(
            f"the package gleaner has version {gleaner.__version__}, and {sys.argv[1]} has "
            f"{extension.__version__}",
            "take both from one installation",
        )
    # Standard output is for reports. Text that a lambda prints goes to its log from its import on;
    # all other output goes to standard error.
    sys.stdout = sys.stderr
    code = INTERNAL
    try:
        code = extension.main(sys.argv[2:], _host)
    finally:
        # All results are written; a thread that the lambda started must not keep the process. An
        # exception here was a panic of the host, which has printed its message.
        os._exit(code)


def load(path: str) -> ModuleType:
    """Loads the extension module from the file `path`, whose name need not be the one that Python
    expects."""
    loader = ExtensionFileLoader("_gleaner", path)
    spec = importlib.util.spec_from_file_location("_gleaner", path, loader=loader)
    try:
        assert spec is not None, "a loader is passed, so there is a spec"
        module = importlib.util.module_from_spec(spec)
        loader.exec_module(module)
    except ImportError as error:
        refuse(str(error), "build it again: cargo build --release")
    sys.modules["_gleaner"] = module
    return module


def refuse(cause: str, help: str) -> NoReturn:
    print(f"error: cannot host lambdas in {sys.executable}", file=sys.stderr)
    print(f"  cause: {cause}\n  help:  {help}", file=sys.stderr)
    sys.exit(USAGE)


if __name__ == "__main__":
    main()
