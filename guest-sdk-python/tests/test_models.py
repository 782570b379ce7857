"""Tests models in a local run: the test determines their answers. Needs no host."""

from __future__ import annotations

import unittest
from typing import Any, Dict, List, Tuple

import home  # noqa: F401
import numpy as np

from gleaner import Context, Detection, InferenceError, Model, Sample, Tensor, TensorInfo
from gleaner.testing import FakeModel, ReplayError, Run, replay


def manifest(**keys: str) -> Dict[str, Any]:
    """Returns a manifest with a model; `keys` are further keys of it."""
    model = {"name": "detector", "file": "detector.onnx", "sha256": "0" * 64, **keys}
    return {
        "lambda": {"name": "probe", "version": "0.1.0", "kind": "python", "entry": "main.py"},
        "schedule": {"event": "camera", "backlog": "each"},
        "input": [{"name": "camera", "topic": "/camera", "type": "sensor_msgs/msg/Image"}],
        "model": [model],
        "limits": {"memory": "1 MiB"},
    }


def run(lambda_: type, frames: int, models: Dict[str, FakeModel]) -> Run:
    image = np.zeros((4, 6, 3), np.uint8)
    arrays = {"/camera": {"t": np.arange(frames), "image": [image] * frames}}
    return replay(lambda_, arrays, manifest=manifest(layout="yolox"), models=models)


def box(class_: int, label: str, score: float) -> Detection:
    return Detection(class_, label, score, 4, 8, 2, 5)


def refused(error: InferenceError) -> Tuple[str, str]:
    return error.kind, str(error)


class Lambda:
    """The base of lambdas that open the model."""

    def __init__(self, ctx: Context) -> None:
        self.model = Model.open("detector")


class Person(Lambda):
    """An event for each person that a model detects."""

    def on_event(self, ctx: Context, event: Sample) -> None:
        for found in self.model.detect(event.as_frame(), classes=["person"]):
            ctx.event(found.label, found.score, x=found.x)


class Models(unittest.TestCase):
    def test_a_lambda_gets_the_detections_that_the_test_sets_for_a_frame(self) -> None:
        def detect(frame: Any) -> List[Detection]:
            self.assertEqual(frame.info.width, 6)
            if frame.identity.seq == 3:
                raise InferenceError("no time is left", "too-slow")
            people = [box(0, "person", 0.5), box(2, "car", 0.9), box(0, "person", 0.75)]
            return people if frame.identity.seq == 1 else [box(0, "person", 0.24)]

        found = run(Person, 3, {"detector": FakeModel(detect)})
        self.assertEqual(
            [(trigger.label, trigger.score, trigger.attributes) for trigger in found.triggers],
            [("person", 0.75, {"x": 4}), ("person", 0.5, {"x": 4})],
        )
        self.assertEqual([decision.at_ns for decision in found.faults], [2_000_000_000])
        fault = found.faults[0].fault
        assert fault is not None
        self.assertTrue(fault.message.endswith("InferenceError: no time is left"), fault.message)

    def test_options_of_detect_select_by_label_or_index_and_are_checked(self) -> None:
        class Options(Lambda):
            def on_event(self, ctx: Context, event: Sample) -> None:
                frame = event.as_frame()

                def scores(**options: Any) -> List[float]:
                    return [found.score for found in self.model.detect(frame, **options)]

                assert scores() == [1.0, 0.9, 0.8]
                assert scores(classes=["2"]) == scores(classes=[2]) == [1.0, 0.9]
                assert scores(classes=["bicycle", "0"]) == [0.8]
                assert scores(classes=["car"], max_count=1) == [1.0]
                assert scores(min_score=0.85) == [1.0, 0.9]
                for options, why in (
                    ({"classes": ["bus"]}, "model `detector` has no class `bus` in its labels"),
                    ({"max_iou": float("nan")}, "`max_iou` is nan; its range is 0 to 1"),
                ):
                    try:
                        scores(**options)
                    except InferenceError as error:
                        assert refused(error) == ("wrong-input", why), str(error)
                    else:
                        raise AssertionError(why)
                try:
                    scores(classes="car")
                except TypeError:
                    assert self.model.labels() == ["person", "bicycle", "car"]
                else:
                    raise AssertionError("one text is not a list of classes")

        boxes = [box(2, "car", 0.9), box(1, "bicycle", 0.8), box(2, "car", 1.0)]
        model = FakeModel(lambda frame: boxes, labels=["person", "bicycle", "car"])
        self.assertEqual(run(Options, 1, {"detector": model}).faults, [])

    def test_a_model_runs_by_a_function_of_arrays(self) -> None:
        class Doubling(Lambda):
            def on_event(self, ctx: Context, event: Sample) -> None:
                array = np.array([[1.5, 4]], np.float32)
                for given in (array, Tensor.from_values(array)):
                    outputs = self.model.run({"images": given})
                    assert list(outputs) == ["2 images"]
                    doubled = outputs["2 images"]
                    assert doubled.dtype == np.float32 and doubled.tolist() == [[3, 8]]
                    assert not doubled.flags.writeable
                assert self.model.inputs() == [TensorInfo("images", "float32", [None, 2])]
                assert self.model.outputs() == [] and self.model.runtime() == "local run"

        model = FakeModel(
            run=lambda inputs: {f"2 {name}": 2 * array for name, array in inputs.items()},
            inputs=[TensorInfo("images", "float32", [None, 2])],
        )
        self.assertEqual(run(Doubling, 1, {"detector": model}).faults, [])

    def test_what_the_test_does_not_answer_is_unavailable(self) -> None:
        found: List[Tuple[str, str]] = []

        class Unanswered:
            def on_event(self, ctx: Context, event: Sample) -> None:
                for call in (
                    lambda: Model.open("segments"),
                    lambda: Model.open("detector"),
                    lambda: Model.open("detector").detect(event.as_frame()),
                    lambda: Model.open("detector").run({}),
                ):
                    try:
                        call()
                    except InferenceError as error:
                        found.append(refused(error))

            def __init__(self, ctx: Context) -> None:
                pass

        run(Unanswered, 1, {})
        unknown = ("no-such-model", "no model `segments`; the manifest has `detector`")
        way_out = 'pass models={"detector": FakeModel(...)} to replay'
        unset = ("unavailable", f"the test has no answers of model `detector`; {way_out}")
        self.assertEqual(found, [unknown, unset, unset, unset])
        found.clear()
        run(Unanswered, 1, {"detector": FakeModel()})
        self.assertEqual([kind for kind, _ in found], ["no-such-model", *["unavailable"] * 2])
        self.assertIn("FakeModel(detect=...)", found[1][1])
        with self.assertRaisesRegex(ReplayError, "no model `segments` for answers"):
            run(Unanswered, 1, {"segments": FakeModel()})

    def test_a_wrong_answer_is_an_error_of_the_test_and_no_fault_of_the_lambda(self) -> None:
        class Calm(Lambda):
            def on_event(self, ctx: Context, event: Sample) -> None:
                try:
                    self.model.detect(event.as_frame())
                    self.model.run({})
                except Exception:
                    ctx.log("warn", "goes on")

        def cause(**answers: Any) -> str:
            with self.assertRaises(ReplayError) as raised:
                run(Calm, 1, {"detector": FakeModel(**{"detect": lambda _: [], **answers})})
            what, why, _ = str(raised.exception).splitlines()
            self.assertRegex(what, "the test's answer of `.*` for model `detector` is wrong")
            return why

        listed, strange = [0, "person", 0.9, 4, 8, 2, 5], {"boxes": np.zeros(1, np.complex64)}
        for answer, why in (
            (None, "None is not a list"),
            ([listed], f"{listed} is not a Detection"),
            ([box(0, "person", 1.5)], f"{box(0, 'person', 1.5)} is not a Detection"),
            ([box(0, "person", 0.5)._replace(width=0)], "Detection(class_=0, label='person'"),
        ):
            self.assertIn(why, cause(detect=lambda frame, answer=answer: answer))
        self.assertIn("[] is not a dict", cause(run=lambda inputs: []))
        self.assertIn("`boxes` is of complex64", cause(run=lambda inputs: strange))
        # An error in the code of the test is raised as it is.
        with self.assertRaises(ZeroDivisionError):
            run(Calm, 1, {"detector": FakeModel(lambda frame: [box(1 // 0, "", 1)])})
        with self.assertRaisesRegex(ReplayError, "answers of model `detector` are not a FakeModel"):
            run(Calm, 1, {"detector": lambda frame: []})  # type: ignore[dict-item]

    def test_frames_that_no_model_accepts_are_refused(self) -> None:
        def fault(frame: Dict[str, Any], **keys: str) -> str:
            drive = {"/camera": {"t": [0], **frame}}
            model = FakeModel(lambda frame: [])
            found = replay(
                Person, drive, manifest=manifest(**keys), models={"detector": model}
            ).faults[0]
            assert found.fault is not None
            return found.fault.message.splitlines()[-1]

        depth = {"width": [1], "height": [1], "step": [2], "data": [[1, 2]], "encoding": ["mono16"]}
        self.assertEqual(
            fault(depth, layout="yolox"),
            "gleaner.inference.InferenceError: a frame of mono16 cannot be the input of a model; "
            "8-bit colour and grey can",
        )
        grey = {"image": [np.zeros((4, 6), np.uint8)]}
        self.assertIn("`detector` has no `layout` in the manifest", fault(grey))

    def test_tensors_take_memory_until_they_are_dropped(self) -> None:
        class Memory(Lambda):
            def on_event(self, ctx: Context, event: Sample) -> None:
                half = Tensor.create("uint8", [1 << 19])
                try:
                    Tensor.create("uint8", [(1 << 19) + 1])
                except InferenceError as error:
                    left = f"{(1 << 19) + 1} bytes, and {1 << 19} are left"
                    assert refused(error)[0] == "wrong-input" and left in str(error), str(error)
                else:
                    raise AssertionError("there is no room")
                del half
                Tensor.create("float64", [1 << 17])

        self.assertEqual(run(Memory, 2, {"detector": FakeModel()}).faults, [])
