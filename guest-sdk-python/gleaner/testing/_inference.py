"""Tensors in memory, and models that answer as the test determines."""

from __future__ import annotations

import contextlib
import math
import numbers
from dataclasses import dataclass
from types import SimpleNamespace
from typing import (
    Any,
    Callable,
    Dict,
    Iterable,
    Iterator,
    List,
    Mapping,
    Optional,
    Sequence,
    Tuple,
    TypeVar,
    get_args,
)

import numpy as np
import numpy.typing as npt

from .. import inference
from ..inference import Detection, DetectOptions, ElementType, InferenceError, Preprocess
from ..inference import TensorInfo
from ._error import ReplayError, TestFailed, quoted
from ._frame import Frame, no_memory
from ._manifest import DeclaredModel
from ._session import piece, u32, u64

T = TypeVar("T")

MAX_DIMENSIONS, MAX_SIDE, MAX_DETECTIONS = 8, 8192, 1024

# The other encodings are Bayer patterns and have 16 bits.
READABLE = ("rgb8", "bgr8", "rgba8", "bgra8", "mono8", "yuv422", "yuv422_yuy2")

RIGHT_ANSWERS = {
    "run": 'return a dict of arrays, such as {"boxes": np.zeros((1, 4), np.float32)}',
    "detect": 'return a list such as [Detection(class_=0, label="person", score=0.9, x=4, y=8, '
    "width=2, height=5)], with a score from 0 to 1 and sides above 0",
}


@dataclass(frozen=True)
class FakeModel:
    """Answers of a test in place of a ``[[model]]`` of the manifest; pass it to ``replay``::

        def detect(frame):
            # A person in the second frame.
            return [Detection(0, "person", 0.9, 4, 8, 2, 5)] if frame.identity.seq == 2 else []

        replay(Lambda, "drive.mcap", models={"detector": FakeModel(detect)})

    The functions may raise InferenceError; the lambda gets it. A wrong answer raises ReplayError,
    and every other exception ends the replay: neither is a fault of the lambda.
    """

    detect: Optional[Callable[[Frame], Iterable[Detection]]] = None
    """Returns the objects in a frame. Of them, the lambda gets those that fit its classes, minimum
    score and maximum number, highest score first. Overlaps are not removed."""
    run: Optional[Callable[[Dict[str, npt.NDArray[Any]]], Mapping[str, npt.ArrayLike]]] = None
    """Returns the outputs by name, from the inputs by name."""
    labels: Sequence[str] = ()
    """Names of the classes. With them, ``detect`` refuses a class that they lack."""
    inputs: Sequence[TensorInfo] = ()
    """The inputs that the lambda can query."""
    outputs: Sequence[TensorInfo] = ()
    """The outputs that the lambda can query."""


class ModelTable:
    """The models of the manifest, with the answers of the test, and the memory of tensors."""

    def __init__(
        self,
        declared: Sequence[DeclaredModel],
        answers: Mapping[str, FakeModel],
        limits: Mapping[str, int],
    ) -> None:
        self.declared = {model.name: model for model in declared}
        self.answers, self.limits = answers, limits
        self.bytes_left = limits["memory"]
        for name, fake in answers.items():
            if name not in self.declared:
                raise ReplayError(
                    f"no model `{name}` for answers",
                    help=f"the manifest has {quoted(self.declared)}",
                )
            if not isinstance(fake, FakeModel):
                help = f'pass models={{"{name}": FakeModel(...)}}'
                raise ReplayError(f"the answers of model `{name}` are not a FakeModel", "", help)


# The models of the lambda that runs.
_table: Optional[ModelTable] = None


@contextlib.contextmanager
def available(table: ModelTable) -> Iterator[None]:
    """Makes tensors and these models available to the functions of `gleaner.inference`."""
    global _table
    before = _table, inference._local
    _table, inference._local = table, SimpleNamespace(Tensor=Tensor, Model=Model)
    try:
        yield
    finally:
        _table, inference._local = before


def _running() -> ModelTable:
    assert _table is not None, "`available` makes the classes reachable"
    return _table


class Tensor:
    """An array in memory."""

    def __init__(self, element: ElementType, shape: Sequence[int]) -> None:
        lengths = [u32(length) for length in shape]
        if element not in get_args(ElementType):
            raise ValueError(
                f"`{element}` is no type of elements; they are {get_args(ElementType)}"
            )
        if len(lengths) > MAX_DIMENSIONS:
            raise _wrong(f"a tensor has at most {MAX_DIMENSIONS} dimensions, not {len(lengths)}")
        if 0 in lengths:
            raise _wrong(f"a tensor of shape {lengths} has no elements")
        self._element, self._shape, self._table = element, lengths, _running()
        self._dtype = np.dtype("bool" if element == "boolean" else element).newbyteorder("<")
        size, left = self._dtype.itemsize * math.prod(lengths), self._table.bytes_left
        if size > left:
            raise _wrong(no_memory(size, left))
        self._table.bytes_left -= size
        self._bytes = bytearray(size)

    def __del__(self) -> None:
        # A refused tensor has none.
        if hasattr(self, "_bytes"):
            self._table.bytes_left += len(self._bytes)

    @staticmethod
    def create(element: ElementType, shape: Sequence[int]) -> Tensor:
        return Tensor(element, shape)

    @staticmethod
    def from_bytes(
        element: ElementType, shape: Sequence[int], bytes: npt.NDArray[np.uint8]
    ) -> Tensor:
        tensor = Tensor(element, shape)
        tensor.write(0, bytes)
        return tensor

    @staticmethod
    def from_frame(frame: Frame, how: Preprocess) -> Tensor:
        _check_frame(frame)
        width, height = u32(how.width), u32(how.height)
        if not all(1 <= side <= MAX_SIDE for side in (width, height)):
            raise _wrong(
                f"a tensor of a frame cannot have {width}x{height} pixels; each side is 1 to "
                f"{MAX_SIDE}"
            )
        raise InferenceError(
            "a local run does not convert frames to tensors; set answers of `detect` with "
            "FakeModel, or run the lambda with gleaner replay",
            "unavailable",
        )

    @property
    def element(self) -> ElementType:
        return self._element

    @property
    def shape(self) -> List[int]:
        return list(self._shape)

    @property
    def size(self) -> int:
        return len(self._bytes)

    def read(self, offset: int = 0, len: Optional[int] = None) -> bytes:
        most = self._table.limits["call_bytes"]
        return piece(bytes(self._bytes), offset, None if len is None else u32(len), most)

    def write(self, offset: int, bytes: Any) -> None:
        start, written = u64(offset), memoryview(bytes).tobytes()
        if start + len(written) > self.size:
            raise _wrong(
                f"{len(written)} bytes at offset {start} exceed a tensor of {self.size} bytes"
            )
        self._bytes[start : start + len(written)] = written

    def array(self) -> npt.NDArray[Any]:
        # A copy, since later writes must not change it: the host copies at a write.
        return np.frombuffer(bytes(self._bytes), self._dtype).reshape(self._shape)


class Model:
    """A ``[[model]]`` that answers as the test determines."""

    def __init__(self, declared: DeclaredModel, answers: FakeModel) -> None:
        self._declared, self._answers = declared, answers

    @staticmethod
    def open(name: str) -> Model:
        table = _running()
        declared = table.declared.get(name)
        if declared is None:
            way_out = "" if table.declared else "; add a [[model]] of this name"
            raise InferenceError(
                f"no model `{str(name)[:64]}`; the manifest has {quoted(table.declared)}{way_out}",
                "no-such-model",
            )
        answers = table.answers.get(name)
        if answers is None:
            raise InferenceError(
                f"the test has no answers of model `{name}`; pass "
                f'models={{"{name}": FakeModel(...)}} to replay',
                "unavailable",
            )
        return Model(declared, answers)

    def inputs(self) -> Sequence[TensorInfo]:
        return self._answers.inputs

    def outputs(self) -> Sequence[TensorInfo]:
        return self._answers.outputs

    def labels(self) -> List[str]:
        return list(self._answers.labels)

    def runtime(self) -> str:
        return "local run"

    def run(self, inputs: List[Tuple[str, Tensor]]) -> List[Tuple[str, Tensor]]:
        if self._answers.run is None:
            raise self._no_answer("run")
        given = {name: tensor.array() for name, tensor in inputs}
        arrays = _answered(self._answers.run, given, self._outputs)
        tensors = {name: inference.Tensor.from_values(array) for name, array in arrays.items()}
        return [(name, tensor._handle) for name, tensor in tensors.items()]  # type: ignore[misc]

    def _outputs(self, answer: Any) -> Dict[str, npt.NDArray[Any]]:
        if not isinstance(answer, Mapping):
            raise self._wrong_answer("run", f"{answer!r:.80} is not a dict")
        arrays = {name: np.asarray(values) for name, values in answer.items()}
        for name, array in arrays.items():
            if array.dtype != np.bool_ and array.dtype.name not in get_args(ElementType):
                cause = f"`{name}` is of {array.dtype}, which a tensor cannot have"
                raise self._wrong_answer("run", cause)
        return arrays

    def _detections(self, answer: Any) -> List[Detection]:
        if not isinstance(answer, Iterable):
            raise self._wrong_answer("detect", f"{answer!r:.80} is not a list")
        found = list(answer)
        for one in found:
            if (
                not isinstance(one, Detection)
                or not isinstance(one.label, str)
                or not isinstance(one.class_, numbers.Integral)
                or not all(isinstance(it, numbers.Real) and math.isfinite(it) for it in one[2:])
                or not (0 <= one.score <= 1 and one.width > 0 and one.height > 0)
            ):
                raise self._wrong_answer("detect", f"{one!r:.160} is not a Detection")
        return [Detection(int(one.class_), one.label, *map(float, one[2:])) for one in found]

    def detect(self, frame: Frame, options: DetectOptions) -> List[Detection]:
        name, answers = self._declared.name, self._answers
        if not self._declared.has_layout:
            raise _wrong(f"model `{name}` has no `layout` in the manifest, for `detect`")
        for option in ("min_score", "max_iou"):
            value = getattr(options, option)
            if not 0 <= value <= 1:
                raise _wrong(f"`{option}` is {value}; its range is 0 to 1")
        unknown = [
            one
            for one in options.classes
            if answers.labels and one not in answers.labels and not one.isdecimal()
        ]
        if unknown:
            raise _wrong(f"model `{name}` has no class `{unknown[0]}` in its labels")
        _check_frame(frame)
        if answers.detect is None:
            raise self._no_answer("detect")
        detections = _answered(answers.detect, frame, self._detections)
        classes = set(options.classes)
        found = [
            one
            for one in detections
            if one.score >= options.min_score
            and (not classes or one.label in classes or str(one.class_) in classes)
        ]
        found.sort(key=lambda one: -one.score)
        return found[: min(u32(options.max_count), MAX_DETECTIONS)]

    def _wrong_answer(self, call: str, cause: str) -> ReplayError:
        what = f"the test's answer of `{call}` for model `{self._declared.name}` is wrong"
        return ReplayError(what, cause, RIGHT_ANSWERS[call])

    def _no_answer(self, call: str) -> InferenceError:
        return InferenceError(
            f"the test has no answer of `{call}` of model `{self._declared.name}`; pass "
            f"FakeModel({call}=...)",
            "unavailable",
        )


def _answered(answer: Callable[[Any], Any], given: Any, check: Callable[[Any], T]) -> T:
    """Calls code of the test, which may raise InferenceError. Its other errors are no faults of the
    lambda."""
    try:
        return check(answer(given))
    except InferenceError:
        raise
    except Exception as error:
        raise TestFailed from error


def _check_frame(frame: Frame) -> None:
    encoding = frame.info.encoding
    if encoding not in READABLE:
        raise _wrong(
            f"a frame of {encoding} cannot be the input of a model; 8-bit colour and grey can"
        )


def _wrong(why: str) -> InferenceError:
    return InferenceError(why, "wrong-input")
