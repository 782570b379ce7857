"""Tests text that a lambda prints in the real host: the log has all output of `sys.stdout` and
`sys.stderr`."""

from __future__ import annotations

import json

from hosted import GREY, Hosted


class Printing(Hosted):
    def printed(self, statement: str, *lines: str) -> None:
        """Asserts that `statement`, in a wake, prints `lines` to standard output."""
        self.replay(f"import sys\ndef on_event(ctx, event): {statement}", [GREY])
        self.assertEqual(self.log(), [("info", line) for line in lines], statement)

    def test_each_printed_line_is_a_log_line_from_the_import_on(self) -> None:
        source = """
            import sys
            print("import")

            class Lambda:
                def __init__(self, ctx):
                    print("init", file=sys.stderr)

                def on_event(self, ctx, event):
                    print("wake", 1)
                    ctx.log("debug", "between")
                    print("wake", 2, file=sys.stderr)
        """
        self.replay(source, [GREY])
        lines = [
            ("info", "import"),
            ("warn", "init"),
            ("info", "wake 1"),
            ("debug", "between"),
            ("warn", "wake 2"),
        ]
        self.assertEqual(self.log(), lines)
        self.assertEqual(
            [line["at_ns"] for line in self.lines("log.jsonl")], [0, 0] + [1_000_000_000] * 3
        )

    def test_a_line_ends_with_its_newline_or_with_the_call(self) -> None:
        self.printed(
            "print('a', end=''); print('b'); print('c\\nd\\n\\n  e'); print('f', end='')",
            "ab",
            *"cd",
            "  e",
            "f",
        )
        source = "def on_event(ctx, event): print('no newline', end='')"
        self.replay(source, [GREY, GREY])
        self.assertEqual(self.log(), [("info", "no newline")] * 2)

    def test_a_long_line_becomes_several(self) -> None:
        self.printed("print('x' * 10_000)", "x" * 4096, "x" * 4096, "x" * 1808)
        self.printed("print('x' * 10_000, end='')", "x" * 4096, "x" * 4096, "x" * 1808)

    def test_any_text_and_any_bytes_can_be_written(self) -> None:
        self.printed("print('é \\ud800')", "é \\ud800")
        self.printed("sys.stdout.buffer.write(b'\\xff\\n'); sys.stdout.write('')", "\ufffd")

    def test_printed_text_is_not_in_the_report_and_logged_once(self) -> None:
        source = "import os\ndef on_event(ctx, event): print('hello'); os.write(1, b'there\\n')"
        ended = self.start(source, [GREY])
        self.assertEqual(
            [json.loads(line)["report"] for line in ended.stdout.splitlines()],
            ["isolation", "summary"],
        )
        self.assertEqual((self.log(), ended.stderr), ([("info", "hello")], "there\n"))

    def test_a_fault_is_reported_once_and_text_printed_before_it_is_kept(self) -> None:
        message = self.fault("def on_event(ctx, event): print('so far'); raise RuntimeError('no')")
        self.assertTrue(message.endswith("RuntimeError: no"), message)
        lines = [line for line in self.log() if not line[1].startswith("gleaner: ")]
        self.assertEqual(lines, [("info", "so far")] * 2)

    def test_text_printed_before_a_failed_start_is_on_standard_error(self) -> None:
        ended = self.start("print('so far')\nraise RuntimeError('no')", [GREY])
        self.assertEqual(ended.returncode, 6)
        self.assertIn("log: so far\n", ended.stderr)
        # The results of an earlier replay stay as they were.
        self.assertFalse((self.folder / "out" / "log.jsonl").exists())

    def test_lines_over_the_limit_are_dropped_and_counted(self) -> None:
        self.replay("def on_event(ctx, event):\n    for n in range(250): print(n)", [GREY])
        summary = json.loads((self.folder / "out" / "summary.json").read_text())
        self.assertEqual((summary["log_lines"], summary["log_dropped"]), (100, 150))

    def test_loggers_and_threads_write_to_the_same_log(self) -> None:
        source = """
            import logging
            import threading

            logging.basicConfig(level="INFO")

            def on_event(ctx, event):
                texts = [f"thread {n} " + "x" * 500 for n in range(8)]
                threads = [threading.Thread(target=print, args=(text,)) for text in texts]
                for thread in threads:
                    thread.start()
                for thread in threads:
                    thread.join()
                logging.info("all of them")
        """
        self.replay(source, [GREY])
        *of_threads, last = self.log()
        self.assertEqual(
            sorted(of_threads), [("info", f"thread {n} " + "x" * 500) for n in range(8)]
        )
        self.assertEqual(last, ("warn", "INFO:root:all of them"))

    def test_no_other_process_can_be_started(self) -> None:
        source = """
            import os, subprocess

            def on_event(ctx, event):
                for start in [os.fork, lambda: subprocess.run(["echo", "other"])]:
                    try:
                        start()
                    except PermissionError:
                        print("refused")
        """
        ended = self.start(source, [GREY])
        self.assertEqual((ended.returncode, ended.stderr), (0, ""))
        self.assertEqual(self.log(), [("info", "refused")] * 2)

    def test_text_printed_after_the_last_wake_goes_to_standard_error(self) -> None:
        source = """
            class Lambda:
                def __init__(self, ctx):
                    pass

                def on_event(self, ctx, event):
                    pass

                def __del__(self):
                    print("goodbye")
        """
        ended = self.start(source, [GREY])
        self.assertEqual((ended.returncode, ended.stderr, self.log()), (0, "goodbye\n", []))

    def test_a_lambda_may_close_detach_and_replace_its_streams(self) -> None:
        for statement, lines in {
            "sys.stdout.close(); sys.stderr.close()": [],
            "sys.stdout = io.TextIOWrapper(sys.stdout.detach(), line_buffering=True); print('a')": [
                ("info", "a")
            ],
            "sys.stdout = sys.stderr = None; print('a')": [],
        }.items():
            self.replay(
                f"import io, sys\n{statement}\ndef on_event(ctx, event): pass", [GREY, GREY]
            )
            self.assertEqual(self.log(), lines, statement)
