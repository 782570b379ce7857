"""Runs a lambda without any runtime: over arrays or a recorded drive, in pytest and in a notebook.

::

    from gleaner.testing import replay
    from main import Lambda                       # the file of the lambda, as it is

    def test_a_stop_is_seen():
        run = replay(Lambda, "drive.mcap", config={"brake_mps2": -1.4})
        assert not run.faults
        assert [round(trigger.at_s, 2) for trigger in run.triggers] == [4.14, 10.81]

Rings with their depth and what a lambda holds, schedules, fields, limits of triggers, log and scratch, faults and what follows
them are those of a replay by the host. Not here: time and memory, so no deadline and no ``memory`` but for frames that are made;
the jail; clips, but for their windows; models. ``docs/python.md`` has more. It wants Python 3.10.
"""

import sys

if sys.version_info < (3, 10):
    raise ImportError(
        "gleaner.testing wants Python 3.10 or newer, as rosbags does; lambdas themselves run on 3.9, too"
    )

from ._drive import Drive
from ._error import ReplayError, StartError
from ._replay import replay
from ._run import Decision, Fault, Run
from ._session import Line
from ._windows import Moment, Window

__all__ = [
    "Decision",
    "Drive",
    "Fault",
    "Line",
    "Moment",
    "ReplayError",
    "Run",
    "StartError",
    "Window",
    "replay",
]
