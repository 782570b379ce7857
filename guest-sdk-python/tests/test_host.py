"""Tests loading a lambda from its file and formatting its exceptions, without a host."""

from __future__ import annotations

import sys
import tempfile
import textwrap
import unittest
import unittest.mock
from pathlib import Path
from typing import Any, Dict

import home  # noqa: F401

from gleaner import Context, DataError, InferenceError, Model, _host


class Files(unittest.TestCase):
    def setUp(self) -> None:
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name).resolve()
        self.addCleanup(setattr, sys, "path", list(sys.path))
        self.addCleanup(setattr, sys, "dont_write_bytecode", sys.dont_write_bytecode)

    def write(self, source: str, name: str = "main.py") -> str:
        path = self.folder / name
        path.write_text(textwrap.dedent(source), encoding="utf-8")
        return str(path)

    def explained(self, *load: str) -> str:
        try:
            _host.load(*load)
        except BaseException as error:
            # The host calls from Rust, which adds no entry to the traceback; this function does.
            outermost = error.__traceback__
            return _host.explain(error.with_traceback(outermost and outermost.tb_next))
        raise AssertionError("nothing was raised")


class Loading(Files):
    ctx: Any = None

    def test_a_class_is_instantiated_and_its_handler_bound(self) -> None:
        source = """
            class Lambda:
                def __init__(self, ctx):
                    self.seen = []

                def on_event(self, ctx, event):
                    self.seen.append(event)
                    return self.seen
        """
        make = _host.load(self.write(source), "on_event")
        handler = make(self.ctx)
        handler(self.ctx, 1)
        self.assertEqual(handler(self.ctx, 2), [1, 2])
        self.assertEqual(make(self.ctx)(self.ctx, 3), [3], "a fresh instance has no state")

    def test_plain_functions_work_and_init_is_optional(self) -> None:
        entry = self.write("def on_tick(ctx): return 'tick'")
        self.assertEqual(_host.load(entry, "on_tick")(self.ctx)(self.ctx), "tick")
        entry = self.write(
            "made = []\ndef init(ctx): made.append(ctx)\ndef on_tick(ctx): return made"
        )
        self.assertEqual(_host.load(entry, "on_tick")(self.ctx)(self.ctx), [self.ctx])

    def test_a_lambda_imports_modules_of_its_folder_and_writes_no_files_there(self) -> None:
        self.addCleanup(sys.modules.pop, "beside", None)
        self.write("state = []", "beside.py")
        entry = self.write(
            "import beside\ndef on_tick(ctx): beside.state.append(1); return len(beside.state)"
        )
        for _ in range(2):
            handler = _host.load(entry, "on_tick")(self.ctx)
            self.assertEqual(handler(self.ctx), 1, "globals are fresh after a second load")
        self.assertEqual(
            sorted(path.name for path in self.folder.iterdir()), ["beside.py", "main.py"]
        )

    def test_a_missing_handler_is_named_with_those_that_exist(self) -> None:
        refusals: Dict[str, str] = {
            "def on_tick(ctx): pass": "`main.py` has no `on_event(ctx, event)`, which `event` in "
            "[schedule] requires; found `on_tick`",
            "class Lambda:\n    def on_tick(self, ctx): pass": "`Lambda` of `main.py` has no "
            "`on_event(self, ctx, event)`, which `event` in [schedule] requires; found `on_tick`",
            "": "`main.py` has no `on_event(ctx, event)`, which `event` in [schedule] requires; "
            "found no handler",
        }
        for source, refusal in refusals.items():
            self.assertEqual(self.explained(self.write(source), "on_event"), refusal)

    def test_a_file_that_is_not_python_is_refused(self) -> None:
        entry = self.write("", "main.wasm")
        self.assertEqual(
            self.explained(entry, "on_event"),
            "`main.wasm` is not a Python file: its name must end with `.py`",
        )


class Formatting(Files):
    def test_a_traceback_begins_in_the_file_of_the_lambda(self) -> None:
        entry = self.write("\nraise RuntimeError('no')\n")
        self.assertEqual(
            self.explained(entry, "on_event"),
            f'Traceback (most recent call last):\n  File "{entry}", line 2, in <module>\n'
            "    raise RuntimeError('no')\nRuntimeError: no",
        )

    def test_a_syntax_error_names_file_and_line(self) -> None:
        entry = self.write("x = 1\ndef on_event(:\n")
        text = self.explained(entry, "on_event")
        self.assertIn(f'File "{entry}", line 2', text)
        self.assertNotIn("importlib", text)

    def test_the_cause_of_an_exception_is_included(self) -> None:
        source = (
            "try:\n    {}['key']\n"
            "except KeyError as error:\n    raise ValueError('no key') from error\n"
        )
        text = self.explained(self.write(source), "on_event")
        self.assertIn("KeyError: 'key'", text)
        self.assertTrue(text.endswith("ValueError: no key"))

    def test_the_traceback_of_an_endless_recursion_is_short(self) -> None:
        text = self.explained(self.write("def deeper(): deeper()\ndeeper()"), "on_event")
        self.assertLess(len(text.splitlines()), 20)
        self.assertIn("RecursionError", text)


class WithoutHost(unittest.TestCase):
    def test_an_error_has_a_kind_and_prints_its_message(self) -> None:
        error = DataError("no input `imo`; the manifest has `imu`", "no-such-input")
        self.assertEqual(
            (str(error), error.kind), ("no input `imo`; the manifest has `imu`", "no-such-input")
        )
        self.assertIsInstance(error, ValueError)

    def test_without_a_host_there_are_no_models(self) -> None:
        hosted = sys.modules.pop("_gleaner", None)
        if hosted is not None:
            self.addCleanup(sys.modules.__setitem__, "_gleaner", hosted)
        with self.assertRaises(InferenceError) as refused:
            Model.open("detector")
        self.assertEqual(refused.exception.kind, "unavailable")

    def test_a_context_can_be_named_in_a_type_hint(self) -> None:
        def on_tick(ctx: Context) -> None: ...

        self.assertEqual(on_tick.__annotations__["ctx"], "Context")

    def test_a_call_with_time_left_goes_on_after_its_signal(self) -> None:
        # As the host states it at each signal: the call had to wait, and then used its time.
        left = [0.001, 0.001, 0.0]
        host = unittest.mock.Mock(time_left=lambda: left.pop(0))

        def endless() -> None:
            while True:
                pass

        with unittest.mock.patch.dict(sys.modules, _gleaner=host):
            result, text, kind = _host.attempt(0.001, endless)
        self.assertEqual((result, kind, left), (None, "deadline", []), text)
