"""Runs the suites of `test_hosted`, `test_printed` and `test_tensors` locally, by inheritance.

Tests that need a process of its own are left out."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import textwrap
import types
import unittest
from pathlib import Path
from typing import Dict, List

import home
import test_hosted
import test_printed
import test_tensors
from local_run import LocalRun
from hosted import EACH, GREY, MANIFEST

from gleaner.testing import replay


class Arrays(LocalRun, test_hosted.Arrays):
    pass


class Data(LocalRun, test_hosted.Data):
    # `rosbags` returns log times only.
    PUBLISHED_NS = 1_000_000_000


class Tensors(LocalRun, test_tensors.Tensors):
    pass


class Triggers(LocalRun, test_hosted.Triggers):
    pass


class Ticks(LocalRun, test_hosted.Ticks):
    pass


class Faults(LocalRun, test_hosted.Faults):
    def test_an_exit_of_the_process_is_a_fault(self) -> None:
        self.assertTrue(
            self.fault("import sys\ndef on_event(ctx, event): sys.exit(3)").endswith(
                "SystemExit: 3"
            )
        )

    def test_ctrl_c_ends_the_replay(self) -> None:
        # In the host it ends the process. Here it must reach the user.
        with self.assertRaises(KeyboardInterrupt):
            self.start("def on_event(ctx, event): raise KeyboardInterrupt", [GREY])

    test_a_panic_of_the_host_is_a_fault_and_the_replay_continues = None  # type: ignore[assignment]
    test_a_running_thread_does_not_keep_the_process = None  # type: ignore[assignment]


class Printing(LocalRun, test_printed.Printing):
    test_printed_text_is_not_in_the_report_and_logged_once = None  # type: ignore[assignment]
    test_no_other_process_can_be_started = None  # type: ignore[assignment]
    test_text_printed_after_the_last_wake_goes_to_standard_error = None  # type: ignore[assignment]
    test_text_printed_before_a_failed_start_is_on_standard_error = None  # type: ignore[assignment]


class Streams(LocalRun):
    def test_the_streams_are_restored(self) -> None:
        before = sys.stdout, sys.stderr, list(sys.path), sys.modules.get("main")
        self.replay("def on_event(ctx, event): print('a')", [GREY])
        self.assertEqual((sys.stdout, sys.stderr, list(sys.path), sys.modules.get("main")), before)
        self.assertEqual(self.log(), [("info", "a")])

    def test_modules_of_a_lambda_are_fresh_in_each_run_and_those_of_a_test_stay(self) -> None:
        beside = self.folder / "build" / "beside.py"
        beside.parent.mkdir()
        beside.write_text("seen = []\n", encoding="utf-8")
        mine = types.ModuleType("test_beside")
        mine.__file__ = str(beside.parent / "test_beside.py")
        sys.modules["test_beside"] = mine
        self.addCleanup(sys.modules.pop, "test_beside")
        self.addCleanup(sys.modules.pop, "beside", None)
        source = (
            "import beside\n"
            "def on_event(ctx, event): beside.seen.append(1); ctx.event('e', len(beside.seen))"
        )
        for _ in range(2):
            decisions = self.replay(source, [GREY, GREY])
            self.assertEqual([decision["triggers"][0]["score"] for decision in decisions], [1, 2])
        self.assertIs(sys.modules["test_beside"], mine)


class Folders(unittest.TestCase):
    """Lambdas passed by their folder, several in one process."""

    def setUp(self) -> None:
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name).resolve()
        before = set(sys.modules)
        self.addCleanup(lambda: [sys.modules.pop(name) for name in set(sys.modules) - before])
        self.addCleanup(setattr, sys, "path", list(sys.path))

    def write(self, name: str, files: Dict[str, str]) -> Path:
        """Writes the folder of a lambda with a manifest and these files."""
        folder = self.folder / name
        for inside, text in {
            "lambda.toml": MANIFEST.format(schedule=EACH, depth=4),
            **files,
        }.items():
            path = folder / inside
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        return folder

    def labels(self, folder: "str | os.PathLike[str]") -> List[str]:
        run = replay(folder, {"/camera": {"t": [0]}})
        self.assertEqual(run.faults, [])
        return [trigger.label for trigger in run.triggers]

    def test_two_lambdas_with_a_module_of_the_same_name_each_import_their_own(self) -> None:
        uses = (
            "from helper import NAME\nimport inner.deep\n"
            "def on_event(ctx, event): ctx.event(NAME + inner.deep.NAME, 0)\n"
        )
        for name in ("a", "b"):
            # The folder `inner` has no `__init__.py`.
            self.write(
                name,
                {
                    "main.py": uses,
                    "helper.py": f"NAME = '{name}'\n",
                    "inner/deep.py": f"NAME = '{name}'\n",
                },
            )
        before = set(sys.modules)
        for name in ("a", "b", "a"):
            self.assertEqual(self.labels(self.folder / name), [name + name])
            self.assertEqual(
                {
                    one
                    for one in set(sys.modules) - before
                    if one.startswith(("helper", "inner", "main"))
                },
                set(),
            )

    def test_folders_can_be_links_and_relative_paths(self) -> None:
        uses = "from helper import NAME\ndef on_event(ctx, event): ctx.event(NAME, 0)\n"
        for name in ("a", "b"):
            self.write(
                name, {"main.py": uses, "helper.py": f"NAME = '{name}'\n", "tests/empty.py": ""}
            )
            (self.folder / f"link-{name}").symlink_to(self.folder / name)
        for name in ("a", "b"):
            self.assertEqual(self.labels(self.folder / f"link-{name}"), [name])
        self.addCleanup(os.chdir, os.getcwd())
        for name in ("a", "b"):
            os.chdir(self.folder / name / "tests")
            self.assertEqual(self.labels(".."), [name])

    def test_modules_of_a_lambda_are_found_before_those_that_a_test_put_on_the_path(self) -> None:
        uses = "from helper import NAME\ndef on_event(ctx, event): ctx.event(NAME, 0)\n"
        for name in ("a", "b"):
            self.write(name, {"main.py": uses, "helper.py": f"NAME = '{name}'\n"})
        sys.path[:0] = [str(self.folder / "a"), str(self.folder / "b")]
        self.assertEqual(self.labels(self.folder / "b"), ["b"])

    def test_an_sdk_in_the_folder_of_the_lambda_is_not_imported_again(self) -> None:
        # The layout of `gleaner new --kind python`.
        source = "from gleaner import DataError\ndef on_event(ctx, event):\n"
        source += "    try:\n        ctx.input('gone')\n"
        source += "    except DataError as error:\n        ctx.event(error.kind, 0)\n"
        folder = self.write("new", {"main.py": source})
        shutil.copytree(
            home.SDK / "gleaner",
            folder / ".gleaner/guest-sdk-python/gleaner",
            ignore=shutil.ignore_patterns("__pycache__"),
        )
        test = """
            import sys
            sys.path[:0] = [".", ".gleaner/guest-sdk-python"]
            import gleaner, gleaner.testing
            known = {name: sys.modules[name] for name in sys.modules if name.startswith("gleaner")}
            assert "/.gleaner/" in gleaner.__file__, gleaner.__file__
            for _ in range(2):
                run = gleaner.testing.replay(".", {"/camera": {"t": [0]}})
                assert not run.faults, run.faults
                labels = [trigger.label for trigger in run.triggers]
                assert labels == ["no-such-input"], run.triggers
            for name, module in known.items():
                assert sys.modules[name] is module, name
        """
        command = [sys.executable, "-c", textwrap.dedent(test)]
        ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=60)
        self.assertEqual(ended.returncode, 0, ended.stderr)
