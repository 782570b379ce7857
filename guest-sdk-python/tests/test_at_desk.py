"""What holds of lambdas in the real host, held at the desk: the suites of `test_hosted` and `test_printed`, by inheritance.

Left out is what only a process of its own can do or refuse."""

from __future__ import annotations

import sys
import types
import unittest

import test_hosted
import test_printed
from at_desk import AtDesk
from hosted import GREY


class Arrays(AtDesk, test_hosted.Arrays):
    pass


class Data(AtDesk, test_hosted.Data):
    # `rosbags` hands out log times only.
    PUBLISHED_NS = 1_000_000_000


class Triggers(AtDesk, test_hosted.Triggers):
    pass


class Ticks(AtDesk, test_hosted.Ticks):
    pass


class Faults(AtDesk, test_hosted.Faults):
    def test_leaving_the_process_is_a_fault_too(self) -> None:
        self.assertTrue(self.fault("import sys\ndef on_event(ctx, event): sys.exit(3)").endswith("SystemExit: 3"))

    def test_ctrl_c_ends_the_replay(self) -> None:
        # In the host it ends the process. Here somebody sits before it.
        with self.assertRaises(KeyboardInterrupt):
            self.start("def on_event(ctx, event): raise KeyboardInterrupt", [GREY])

    test_a_panic_of_the_host_is_a_fault_and_not_the_end = None  # type: ignore[assignment]
    test_a_thread_left_behind_does_not_keep_the_process = None  # type: ignore[assignment]


class Printing(AtDesk, test_printed.Printing):
    test_what_is_printed_is_no_report_and_not_said_twice = None  # type: ignore[assignment]
    test_no_other_process_can_be_started = None  # type: ignore[assignment]
    test_a_farewell_after_the_last_wake_goes_to_standard_error = None  # type: ignore[assignment]
    test_a_lambda_that_cannot_start_has_printed_too = None  # type: ignore[assignment]


class Streams(AtDesk):
    def test_afterwards_the_streams_are_those_of_before(self) -> None:
        before = sys.stdout, sys.stderr, list(sys.path), sys.modules.get("main")
        self.replay("def on_event(ctx, event): print('a')", [GREY])
        self.assertEqual((sys.stdout, sys.stderr, list(sys.path), sys.modules.get("main")), before)
        self.assertEqual(self.log(), [("info", "a")])

    def test_modules_beside_a_lambda_are_fresh_in_each_run_and_those_of_a_test_stay(self) -> None:
        beside = self.folder / "build" / "beside.py"
        beside.parent.mkdir()
        beside.write_text("seen = []\n", encoding="utf-8")
        mine = types.ModuleType("test_beside")
        mine.__file__ = str(beside.parent / "test_beside.py")
        sys.modules["test_beside"] = mine
        self.addCleanup(sys.modules.pop, "test_beside")
        self.addCleanup(sys.modules.pop, "beside", None)
        source = "import beside\ndef on_event(ctx, event): beside.seen.append(1); ctx.event('e', len(beside.seen))"
        for _ in range(2):
            decisions = self.replay(source, [GREY, GREY])
            self.assertEqual([decision["triggers"][0]["score"] for decision in decisions], [1, 2])
        self.assertIs(sys.modules["test_beside"], mine)


if __name__ == "__main__":
    unittest.main()
