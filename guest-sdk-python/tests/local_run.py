"""Runs a lambda of a test locally: `gleaner.testing` in place of the real host, with the interface
of `hosted`.

A test of hosted behaviour that checks decisions and log can run on both, by inheriting from
`LocalRun` first."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any, Dict, List

import home  # noqa: F401
from hosted import Hosted

from gleaner.testing import Run, StartError, replay


class LocalRun(Hosted):
    def find_extension(self) -> str:
        """Returns no extension: a local run needs none."""
        return ""

    def run_built(self) -> "subprocess.CompletedProcess[str]":
        """Replays as the host does, and writes the same result files."""
        try:
            run = replay(self.folder / "build", self.folder / "drive.mcap")
        except StartError as error:
            return subprocess.CompletedProcess([], 6, "", f"error: {error}")
        self.keep(run)
        return subprocess.CompletedProcess([], 6 if run.faults else 0, "", "")

    def keep(self, run: Run) -> None:
        out = self.folder / "out"
        out.mkdir(exist_ok=True)
        lines(out / "decisions.jsonl", [decision.as_json() for decision in run.decisions])
        lines(out / "log.jsonl", [vars(line) for line in run.log])
        lines(out / "clips.jsonl", [window._asdict() for window in run.windows])
        summary = {"log_lines": len(run.log), "log_dropped": run.log_dropped}
        (out / "summary.json").write_text(json.dumps(summary), encoding="utf-8")


def lines(path: Path, objects: List[Dict[str, Any]]) -> None:
    path.write_text("".join(json.dumps(one) + "\n" for one in objects), encoding="utf-8")
