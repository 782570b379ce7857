"""Test data that cannot be in the project, as `base/src/shared_data.rs` finds it for Rust."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def shared(name: str) -> Path:
    """Returns the file `data/NAME` in the folder that `GLEANER_SHARED` names; skips the test if
    there is none."""
    folder = os.environ.get("GLEANER_SHARED", "")
    path = Path(folder, "data", name)
    if not folder or not path.exists():
        pytest.skip(f"set GLEANER_SHARED to the folder that has data/{name}")
    return path
