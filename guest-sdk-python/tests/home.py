"""Locates the code under test. Importing this module makes `gleaner` and `start` importable."""

from __future__ import annotations

import os
import sys
import unittest
from pathlib import Path
from types import ModuleType

SDK = Path(__file__).resolve().parents[1]
CHECKOUT = SDK.parent
sys.path.insert(0, str(SDK))


def extension_path() -> str:
    """Returns the path of the extension `_gleaner`, from GLEANER_EXTENSION; skips the test if it is
    not set."""
    path = os.environ.get("GLEANER_EXTENSION")
    if not path:
        raise unittest.SkipTest("GLEANER_EXTENSION does not name lib_gleaner.so")
    return os.path.abspath(path)


def extension() -> ModuleType:
    """Returns the module `_gleaner`; skips the test if it is not built."""
    if "_gleaner" not in sys.modules:
        import start

        start.load(extension_path())
    return sys.modules["_gleaner"]
