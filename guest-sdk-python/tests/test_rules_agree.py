"""Rules of the host that a lambda can meet, each met by the same lambda in the host and at the desk: decisions and log are equal."""

from __future__ import annotations

import unittest
from typing import Any, Dict, List, Optional, Tuple

import home
from at_desk import AtDesk
from drive import Image
from hosted import EACH, GREY, Hosted

Found = Tuple[List[Dict[str, Any]], List[Dict[str, Any]]]


class Agree(unittest.TestCase):
    clips: List[Tuple[int, int]] = []

    def both(self, source: str, images: List[Image], **how: Any) -> Found:
        """What both decided and logged; of a fault's message the last line, since the desk's own code is in a traceback."""
        home.extension_path()
        theirs, clips = self.found(Hosted(), source, images, how), self.clips
        ours = self.found(AtDesk(), source, images, how)
        self.assertEqual((ours, self.clips), (theirs, clips))
        return theirs

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
        # Where one that nobody stopped ends is not said by its window but by the drive.
        last_ns = max(decision["at_ns"] for decision in decisions)
        self.clips = [
            (clip["from_ns"], min(clip["to_ns"], last_ns)) for clip in case.lines("clips.jsonl")
        ]
        return decisions, case.lines("log.jsonl")

    def scores(self, found: Found) -> List[Optional[float]]:
        return [trigger["score"] for decision in found[0] for trigger in decision["triggers"]]

    def test_a_lambda_that_holds_too_much_makes_the_ring_refuse(self) -> None:
        # Three are shown, two may be held beyond, and the one that is written needs the last cell.
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
            self.scores(found)[::2], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0], "three samples woke nobody"
        )

    def test_what_is_let_go_makes_room_again(self) -> None:
        source = """
            kept = []

            def on_event(ctx, event):
                kept.append(event.as_frame() if event.identity.seq % 2 else event)
                if len(kept) == 7:
                    kept.clear()
                shown = [sample.identity.seq for sample in ctx.input("camera").last(9)]
                ctx.event("shown", len(shown), seqs=str(shown), no_slot=ctx.input("camera").counts().no_slot)
        """
        self.assertIn(4.0, self.scores(self.both(source, [GREY] * 30)))

    def test_a_held_sample_leaves_the_ring_and_others_their_place(self) -> None:
        source = """
            kept = []

            def on_event(ctx, event):
                if event.identity.seq in (2, 3, 5, 8):
                    kept.append(event.as_frame().array())
                shown = [sample.identity.seq for sample in ctx.input("camera").last(9)]
                column = ctx.input("camera").column("header.stamp.sec", 9)
                ctx.event("shown", len(column.values), seqs=str(shown), at=str(column.at_ns.tolist()))
        """
        self.both(source, [GREY] * 20)

    def test_after_eight_faults_in_a_row_it_rests_and_then_goes_on(self) -> None:
        source = """
            def on_event(ctx, event):
                if event.identity.seq < 40:
                    raise RuntimeError(f"in wake {event.identity.seq}")
                ctx.event("well again", event.identity.seq)
        """
        decisions, log = self.both(source, [GREY] * 60, at_ms=range(1000, 61 * 100 + 1000, 100))
        faults = [decision for decision in decisions if decision["fault"]]
        self.assertTrue(8 < len(faults) < 39, "it rested")
        self.assertTrue(any("8 times in a row" in line["message"] for line in log))

    def test_windows_are_those_of_clips(self) -> None:
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
        record = '[record]\ntopics = ["/camera"]\npreroll = "150ms"\npostroll = "250ms"\ncooldown = "COOLDOWN"'
        windows = 0
        for seed, cooldown in enumerate(["0s", "0s", "300ms", "1s"]):
            schedule = EACH + "\n" + record.replace("COOLDOWN", cooldown)
            case = source.replace("SEED", str(seed))
            self.both(case, [GREY] * 80, schedule=schedule, at_ms=range(1000, 9000, 100))
            windows += len(self.clips)
        self.assertGreater(windows, 10)

    def test_a_wake_causes_sixteen_triggers_at_most(self) -> None:
        source = "def on_event(ctx, event):\n    for n in range(20): ctx.event('e', n)"
        decisions, _ = self.both(source, [GREY, GREY])
        self.assertEqual([len(decision["triggers"]) for decision in decisions], [16, 16])

    def test_refused_triggers_are_told_in_the_same_words(self) -> None:
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
                        ours = hasattr(error, "kind")
                        ctx.log("info", f"{n}: {type(error).__name__} {getattr(error, 'kind', '')} {error if ours else ''}")
        """
        _, log = self.both(source, [GREY])
        self.assertEqual(len(log), 19)

    def test_paths_are_refused_in_the_same_words(self) -> None:
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
                for path in {paths!r} + ["x" * 2000, "header.frame_id", "header.stamp.nanosec", "data"]:
                    try:
                        ctx.log("info", f"{{path[:20]}}: {{event.get(path)!r}} {{event.number(path)!r}}")
                    except ValueError as error:
                        ctx.log("info", f"{{path[:20]}}: {{error.kind}} {{error}}")
        """
        _, log = self.both(source, [GREY])
        self.assertEqual(len(log), 13)

    def test_an_element_that_is_not_there_contradicts_the_type(self) -> None:
        source = """
            def on_event(ctx, event):
                try:
                    event.get("data[9]")
                except ValueError as error:
                    ctx.log("info", error.kind)
        """
        _, log = self.both(source, [GREY])
        self.assertEqual([line["message"] for line in log], ["malformed"])

    def test_what_is_no_picture_is_refused_in_the_same_way(self) -> None:
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


if __name__ == "__main__":
    unittest.main()
