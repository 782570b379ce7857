"""Compares the rules of a local replay with those of the host: the same lambda has equal decisions
and log in both."""

from __future__ import annotations

import unittest
from typing import Any, Dict, List, Optional, Tuple

import home
from local_run import LocalRun
from drive import Image
from hosted import EACH, GREY, Hosted

Found = Tuple[List[Dict[str, Any]], List[Dict[str, Any]]]


class Agree(unittest.TestCase):
    clips: List[Tuple[int, int]] = []

    def both(self, source: str, images: List[Image], **how: Any) -> Found:
        """Decisions and log of both. Of a fault's message only the last line is compared, since a
        local traceback includes the code of the SDK."""
        home.extension_path()
        hosted, clips = self.found(Hosted(), source, images, how), self.clips
        local = self.found(LocalRun(), source, images, how)
        self.assertEqual((local, self.clips), (hosted, clips))
        return hosted

    def found(self, case: Hosted, source: str, images: List[Image], how: Dict[str, Any]) -> Found:
        case.setUp()
        self.addCleanup(case.doCleanups)
        ended = case.start(source, images, **how)
        self.assertIn(ended.returncode, (0, 6), ended.stderr)
        decisions = [
            {key: value for key, value in it.items() if key != "run_ns"} for it in case.decisions()
        ]
        for decision in decisions:
            if decision["fault"]:
                decision["fault"]["message"] = decision["fault"]["message"].splitlines()[-1]
        # A recording without a stop ends with the drive, not with its window.
        last_ns = max(decision["at_ns"] for decision in decisions)
        self.clips = [
            (clip["from_ns"], min(clip["to_ns"], last_ns)) for clip in case.lines("clips.jsonl")
        ]
        return decisions, case.lines("log.jsonl")

    def scores(self, found: Found) -> List[Optional[float]]:
        return [trigger["score"] for decision in found[0] for trigger in decision["triggers"]]

    def test_the_ring_refuses_samples_if_a_lambda_holds_too_many(self) -> None:
        # Three samples are shown, two more may be held, and the last cell is for the next sample.
        source = """
            kept = []

            def on_event(ctx, event):
                counts = ctx.input("camera").counts()
                ctx.event("kept", len(kept), **counts._replace(lost=-1)._asdict())
                ctx.event("shown", len(ctx.input("camera").last(9)))
                if len(kept) < 6:
                    kept.append(event)
        """
        found = self.both(source, [GREY] * 9, depth=3)
        self.assertEqual(
            self.scores(found)[::2],
            [0.0, 1.0, 2.0, 3.0, 4.0, 5.0],
            "three samples did not wake the lambda",
        )

    def test_released_samples_free_their_cells(self) -> None:
        source = """
            kept = []

            def on_event(ctx, event):
                kept.append(event.as_frame() if event.identity.seq % 2 else event)
                if len(kept) == 7:
                    kept.clear()
                shown = [sample.identity.seq for sample in ctx.input("camera").last(9)]
                no_slot = ctx.input("camera").counts().no_slot
                ctx.event("shown", len(shown), seqs=str(shown), no_slot=no_slot)
        """
        self.assertIn(4.0, self.scores(self.both(source, [GREY] * 30)))

    def test_a_held_sample_leaves_the_ring_and_others_stay(self) -> None:
        source = """
            kept = []

            def on_event(ctx, event):
                if event.identity.seq in (2, 3, 5, 8):
                    kept.append(event.as_frame().array())
                shown = [sample.identity.seq for sample in ctx.input("camera").last(9)]
                column = ctx.input("camera").column("header.stamp.sec", 9)
                at_ns = str(column.at_ns.tolist())
                ctx.event("shown", len(column.values), seqs=str(shown), at=at_ns)
        """
        self.both(source, [GREY] * 20)

    def test_after_eight_faults_in_a_row_it_backs_off_and_then_continues(self) -> None:
        source = """
            def on_event(ctx, event):
                if event.identity.seq < 40:
                    raise RuntimeError(f"in wake {event.identity.seq}")
                ctx.event("well again", event.identity.seq)
        """
        decisions, log = self.both(source, [GREY] * 60, at_ms=range(1000, 61 * 100 + 1000, 100))
        faults = [decision for decision in decisions if decision["fault"]]
        self.assertTrue(8 < len(faults) < 39, "it backed off")
        self.assertTrue(any("8 times in a row" in line["message"] for line in log))

    def test_windows_are_those_of_the_clips(self) -> None:
        source = """
            import random

            chance = random.Random(SEED)

            def on_event(ctx, event):
                kind = chance.random()
                if kind < 0.15:
                    ctx.event("e", kind)
                elif kind < 0.22:
                    ctx.start(chance.choice("ab"))
                elif kind < 0.3:
                    ctx.stop(chance.choice("ab"))
        """
        record = (
            '[record]\ntopics = ["/camera"]\npreroll = "150ms"\npostroll = "250ms"\n'
            'cooldown = "COOLDOWN"'
        )
        windows = 0
        for seed, cooldown in enumerate(["0s", "0s", "300ms", "1s"]):
            schedule = EACH + "\n" + record.replace("COOLDOWN", cooldown)
            case = source.replace("SEED", str(seed))
            self.both(case, [GREY] * 80, schedule=schedule, at_ms=range(1000, 9000, 100))
            windows += len(self.clips)
        self.assertGreater(windows, 10)

    def test_a_wake_has_at_most_sixteen_triggers(self) -> None:
        source = "def on_event(ctx, event):\n    for n in range(20): ctx.event('e', n)"
        decisions, _ = self.both(source, [GREY, GREY])
        self.assertEqual([len(decision["triggers"]) for decision in decisions], [16, 16])

    def test_errors_of_triggers_have_the_same_messages(self) -> None:
        source = """
            def on_event(ctx, event):
                attempts = [
                    lambda: ctx.event("x" * 129, 1.0),
                    lambda: ctx.event("e", float("nan")),
                    lambda: ctx.event("e", 1.0, **{f"a{n}": n for n in range(17)}),
                    lambda: ctx.event("e", 1.0, **{"k" * 65: 1}),
                    lambda: ctx.event("e", 1.0, value=float("inf")),
                    lambda: ctx.event("e", 1.0, value="é" * 513),
                    lambda: ctx.event("e", 1.0, value=None),
                    lambda: ctx.event("e", "1.0"),
                    lambda: ctx.event(1, 1.0),
                    lambda: ctx.event("e", 1.0, value=2**63),
                    lambda: ctx.start(""),
                    lambda: ctx.log("loud", "a"),
                    lambda: ctx.scratch.put("a", b"1"),
                    lambda: ctx.scratch.put("", b""),
                    lambda: ctx.scratch.put("a\\nb\\0\\x9f", b""),
                    lambda: ctx.scratch.get("a"),
                    lambda: ctx.input("camera").last(-1),
                    lambda: ctx.input("camera").since(0.5),
                    lambda: ctx.input("camera").column(3, 1),
                ]
                for n, attempt in enumerate(attempts):
                    try:
                        attempt()
                    except Exception as error:
                        has_kind = hasattr(error, "kind")
                        shown = (getattr(error, "kind", ""), error if has_kind else "")
                        ctx.log("info", f"{n}: {type(error).__name__} {shown[0]} {shown[1]}")
        """
        _, log = self.both(source, [GREY])
        self.assertEqual(len(log), 19)

    def test_errors_of_paths_have_the_same_messages(self) -> None:
        paths = [
            "header",
            "header.stamp",
            "data[0]",
            "data.x",
            "width.x",
            "width[0]",
            "a..b",
            "",
            "header..x",
        ]
        source = f"""
            def on_event(ctx, event):
                more = ["x" * 2000, "header.frame_id", "header.stamp.nanosec", "data"]
                for path in {paths!r} + more:
                    try:
                        values = (event.get(path), event.number(path))
                        ctx.log("info", f"{{path[:20]}}: {{values[0]!r}} {{values[1]!r}}")
                    except ValueError as error:
                        ctx.log("info", f"{{path[:20]}}: {{error.kind}} {{error}}")
        """
        _, log = self.both(source, [GREY])
        self.assertEqual(len(log), 13)

    def test_a_missing_element_is_malformed(self) -> None:
        source = """
            def on_event(ctx, event):
                try:
                    event.get("data[9]")
                except ValueError as error:
                    ctx.log("info", error.kind)
        """
        _, log = self.both(source, [GREY])
        self.assertEqual([line["message"] for line in log], ["malformed"])

    def test_errors_of_images_have_the_same_messages(self) -> None:
        source = """
            def on_event(ctx, event):
                try:
                    event.as_frame()
                except ValueError as error:
                    ctx.log("info", f"{error.kind} {str(error).split('; supported')[0]}")
        """
        images = [
            Image(2, 1, "mono9", 2, b"\0\0"),
            Image(0, 1, "mono8", 2, b"\0\0"),
            Image(2, 1, "mono8", 1, b"\0\0"),
            Image(2, 2, "mono8", 2, b"\0\0"),
            Image(3, 1, "yuv422", 6, bytes(6)),
        ]
        _, log = self.both(source, images)
        self.assertEqual(len(log), len(images))
