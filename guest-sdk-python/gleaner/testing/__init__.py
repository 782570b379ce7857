"""Runs a lambda locally, without the runtime: over arrays or a recorded drive, in pytest or a
notebook.

::

    from gleaner.testing import replay
    from main import Lambda                       # the file of the lambda, as it is

    def test_a_stop_is_seen():
        run = replay(Lambda, "drive.mcap", config={"brake_mps2": -1.4})
        assert not run.faults
        assert [round(trigger.at_s, 2) for trigger in run.triggers] == [4.14, 10.81]

Rings with depth and held samples, schedules, fields, limits of triggers, log and scratch, faults
and back-off follow the rules of a replay by the host. A model answers as the test determines: see
``FakeModel``. Not included: deadlines; the limit ``memory``, except of frames and tensors that the
lambda creates; the sandbox; clips, except their windows; models, and frames as tensors. See
``docs/python.md``. Requires Python 3.10.
"""

import sys

if sys.version_info < (3, 10):
    raise ImportError(
        "gleaner.testing requires Python 3.10 or newer, as rosbags does; lambdas themselves also "
        "run on 3.9"
    )

from ._drive import Drive
from ._error import ReplayError, StartError
from ._inference import FakeModel
from ._replay import replay
from ._run import Decision, Fault, Run
from ._session import LogLine
from ._windows import Trigger, Window

__all__ = [
    "Decision",
    "Drive",
    "FakeModel",
    "Fault",
    "LogLine",
    "ReplayError",
    "Run",
    "StartError",
    "Trigger",
    "Window",
    "replay",
]
