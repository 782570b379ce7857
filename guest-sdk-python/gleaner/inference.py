"""Models that run in the host: interface ``inference`` of the WIT package.

::

    from gleaner import Context, Model, Sample

    class Lambda:
        def __init__(self, ctx: Context) -> None:
            self.detector = Model.open("detector")

        def on_event(self, ctx: Context, event: Sample) -> None:
            for found in self.detector.detect(event.as_frame(), classes=["person"]):
                ctx.event("person", found.score)

``Tensor`` and ``Model`` convert between numpy and the objects of the host, which ``HostTensor`` and
``HostModel`` describe.
"""

from __future__ import annotations

import importlib
from typing import (
    TYPE_CHECKING,
    Any,
    Dict,
    List,
    Literal,
    Mapping,
    NamedTuple,
    Optional,
    Protocol,
    Sequence,
    Tuple,
    Union,
    get_args,
)

from .error import Error

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from .data import Frame

ElementType = Literal[
    "float32",
    "float16",
    "float64",
    "int8",
    "int16",
    "int32",
    "int64",
    "uint8",
    "boolean",
]
"""Type of the elements of a tensor: the name of the type in numpy, except ``boolean`` for bool."""

Placement = Literal["stretch", "centre", "corner"]
"""Place of a frame in the input tensor of a model. ``stretch``: the frame is stretched to the whole
tensor. ``centre``: the aspect ratio is kept; the frame is in the middle, with a border around it.
``corner``: the aspect ratio is kept; the frame is in the upper left corner."""

InferenceErrorKind = Literal["unavailable", "no-such-model", "wrong-input", "too-slow", "failed"]


class InferenceError(Error):
    """An error in creating a tensor, or in opening or running a model. The message names the
    object, the cause and the way out.

    ``unavailable``: the process that runs models has ended or is not ready; a later call may
    succeed. ``no-such-model``: the manifest has no ``[[model]]`` of that name. ``wrong-input``:
    name, shape or type of a tensor does not fit the model, or a value is out of range.
    ``too-slow``: the models of this wake took longer than ``model_time`` in ``[limits]``.
    ``failed``: the model cannot be loaded, or its run failed.
    """

    kind: InferenceErrorKind


class TensorInfo(NamedTuple):
    """An input or output of a model."""

    name: str
    """Its name in the model."""
    element: ElementType
    """Type of its elements."""
    shape: List[Optional[int]]
    """Length of each dimension; None for one that may have any length."""


class Preprocess(NamedTuple):
    """Conversion of a frame to the input tensor of a model."""

    width: int
    """Width of the tensor in pixels, 1 to 8,192."""
    height: int
    """Height of the tensor in pixels, 1 to 8,192."""
    placement: Placement = "centre"
    """Place of the frame in the tensor."""
    fill: int = 114
    """Grey level of the border, 0 to 255."""
    bgr: bool = False
    """Channel order of the tensor: true for blue first, false for red first."""
    channels_last: bool = False
    """True for shape (1, height, width, 3), false for (1, 3, height, width)."""
    bytes: bool = False
    """True for bytes from 0 to 255, without the numbers below; false for 32-bit floats."""
    scale: float = 1 / 255
    """Each channel becomes ``(value * scale - mean) / deviation``, with ``value`` from 0 to
    255."""
    mean: Tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Mean of each channel, in the order of the tensor. See ``scale``."""
    deviation: Tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Deviation of each channel, in the order of the tensor; not 0. See ``scale``."""


class Detection(NamedTuple):
    """An object that ``detect`` found; its box is in pixels of the frame."""

    class_: int
    """Class index of the model. It is ``class`` in the WIT, which is a keyword of Python."""
    label: str
    """Name of the class from ``labels`` in the manifest; without labels, the index as text."""
    score: float
    """Confidence, 0 to 1."""
    x: float
    """Left edge."""
    y: float
    """Upper edge."""
    width: float
    """Width, above 0."""
    height: float
    """Height, above 0."""


class DetectOptions(NamedTuple):
    """Options of ``detect``; ``Model.detect`` has a parameter for each."""

    classes: Sequence[str] = ()
    """Classes to return, by name or by index as text; empty for all."""
    min_score: float = 0.25
    """Minimum score, 0 to 1; detections with a lower one are dropped."""
    max_iou: float = 0.45
    """Overlap (intersection over union), 0 to 1, above which the detection with the lower score is
    dropped."""
    max_count: int = 100
    """Maximum number of detections, highest score first; clamped to 1,024."""


class Tensor:
    """An array in row-major order, kept in the host. ``numpy.asarray`` accepts it without a copy.

    Tensors of a lambda count against ``memory`` in ``[limits]``.
    """

    def __init__(self, handle: HostTensor) -> None:
        self._handle = handle

    @staticmethod
    def create(element: ElementType, shape: Sequence[int]) -> Tensor:
        """Creates a tensor of zeros.

        Raises InferenceError: ``wrong-input`` for more than 8 dimensions, a length of 0, or too
        many bytes."""
        return Tensor(_host().Tensor.create(element, list(shape)))

    @staticmethod
    def from_values(values: npt.ArrayLike) -> Tensor:
        """Creates a tensor from an array, with its shape and the type of its elements.

        Raises InferenceError: ``wrong-input`` for a type of elements that tensors do not have, such
        as ``uint16`` or ``complex64``; as :meth:`create`."""
        # Imported here, because numpy is loaded in the sandboxed process.
        import numpy as np

        array = np.asarray(values)
        element = "boolean" if array.dtype == np.bool_ else array.dtype.name
        if element not in get_args(ElementType):
            allowed = ", ".join(get_args(ElementType))
            raise InferenceError(
                f"an array of {array.dtype} cannot be a tensor; convert it with `astype` to one of "
                f"{allowed}",
                "wrong-input",
            )
        little_endian = array.astype(array.dtype.newbyteorder("<"), order="C", copy=False)
        return Tensor(
            _host().Tensor.from_bytes(
                element, list(array.shape), little_endian.reshape(-1).view(np.uint8)
            )
        )

    @staticmethod
    def from_frame(frame: Frame, how: Preprocess) -> Tensor:
        """Creates a tensor from a frame, in a form of ``Preprocess``.

        Raises InferenceError: ``wrong-input`` for Bayer and 16-bit encodings and for sizes out of
        range."""
        return Tensor(_host().Tensor.from_frame(frame, how))

    @property
    def element(self) -> ElementType:
        """Type of the elements."""
        return self._handle.element

    @property
    def shape(self) -> list[int]:
        """Length of each dimension."""
        return self._handle.shape

    @property
    def size(self) -> int:
        """Size in bytes."""
        return self._handle.size

    def read(self, offset: int = 0, len: int | None = None) -> bytes:
        """Returns a copy of bytes of the elements, little-endian: at most ``len``, from ``offset``,
        clamped to the tensor and to ``call_bytes`` in ``[limits]``, 1 MiB by default.
        :meth:`array` needs no copy."""
        return self._handle.read(offset, len)

    def write(self, offset: int, bytes: bytes | bytearray | memoryview) -> None:
        """Writes bytes of elements, little-endian, at ``offset``. Bytes of booleans are 0 or 1.

        Raises InferenceError: ``wrong-input`` if they exceed the tensor."""
        self._handle.write(offset, bytes)

    def array(self) -> npt.NDArray[Any]:
        """Returns the elements as a read-only array, without a copy. A later :meth:`write` does not
        change the array. Its memory is held until its last view is dropped."""
        return self._handle.array()

    def __array__(self, *arguments: Any, **named: Any) -> npt.NDArray[Any]:
        """Returns the array of :meth:`array`, for ``numpy.asarray``."""
        return self.array().__array__(*arguments, **named)

    def __repr__(self) -> str:
        return f"<Tensor {self.element} {self.shape}>"


class Model:
    """A loaded ``[[model]]``."""

    def __init__(self, handle: HostModel) -> None:
        self._handle = handle

    @staticmethod
    def open(name: str) -> Model:
        """Opens the model ``name`` of the manifest, and waits until it is loaded. Do this in
        ``__init__``.

        Raises InferenceError: ``no-such-model``; ``failed`` if the model cannot be loaded;
        ``unavailable``; ``too-slow``."""
        return Model(_host().Model.open(name))

    def inputs(self) -> list[TensorInfo]:
        """Returns the inputs."""
        return [TensorInfo(*info) for info in self._handle.inputs()]

    def outputs(self) -> list[TensorInfo]:
        """Returns the outputs."""
        return [TensorInfo(*info) for info in self._handle.outputs()]

    def labels(self) -> list[str]:
        """Returns the names of the classes, from ``labels`` in the manifest."""
        return self._handle.labels()

    def runtime(self) -> str:
        """Returns backend, version, provider and threads, such as ``rten 0.27.0, cpu, 1
        thread``."""
        return self._handle.runtime()

    def run(
        self, inputs: Mapping[str, Union[Tensor, npt.ArrayLike]]
    ) -> dict[str, npt.NDArray[Any]]:
        """Runs the model once with these inputs, tensors or arrays; returns the outputs by name, in
        the order of :meth:`outputs`, as read-only arrays.

        Raises InferenceError: ``wrong-input`` if names, shapes or types do not fit; ``failed``;
        ``unavailable``; ``too-slow``."""
        tensors = {
            name: given if isinstance(given, Tensor) else Tensor.from_values(given)
            for name, given in inputs.items()
        }
        outputs = self._handle.run([(name, tensor._handle) for name, tensor in tensors.items()])
        return {name: tensor.array() for name, tensor in outputs}

    def detect(
        self,
        frame: Frame,
        classes: Sequence[str | int] = (),
        min_score: float = 0.25,
        max_iou: float = 0.45,
        max_count: int = 100,
    ) -> list[Detection]:
        """Finds objects in a frame; returns them by score, highest first. ``layout`` in the
        manifest determines the input and the meaning of the outputs; ``DetectOptions`` explains the
        options. ``classes`` may have indices as numbers, too.

        Raises InferenceError: ``wrong-input`` if the model has no ``layout``, for an unknown class,
        and for frames that ``Tensor.from_frame`` refuses; ``failed``; ``unavailable``;
        ``too-slow``."""
        if isinstance(classes, str):
            raise TypeError("classes must be a sequence of texts, not one text")
        options = DetectOptions(tuple(map(str, classes)), min_score, max_iou, max_count)
        return [Detection(*found) for found in self._handle.detect(frame, options)]

    def __repr__(self) -> str:
        return f"<Model {self.runtime()}>"


class HostTensor(Protocol):
    """The host's object of a tensor, as in the WIT."""

    @staticmethod
    def create(element: str, shape: Sequence[int]) -> HostTensor: ...

    @staticmethod
    def from_bytes(element: str, shape: Sequence[int], bytes: npt.NDArray[np.uint8]) -> HostTensor:
        """Creates a tensor from its bytes, little-endian. Raises as ``create``, and if their number
        is not that of the shape."""

    @staticmethod
    def from_frame(frame: Frame, how: Preprocess) -> HostTensor: ...

    @property
    def element(self) -> ElementType: ...

    @property
    def shape(self) -> List[int]: ...

    @property
    def size(self) -> int: ...

    def read(self, offset: int = 0, len: Optional[int] = None) -> bytes: ...

    def write(self, offset: int, bytes: Union[bytes, bytearray, memoryview]) -> None: ...

    def array(self) -> npt.NDArray[Any]:
        """Returns a read-only array over the host's memory, which it holds. A later write does not
        change the array."""


class HostModel(Protocol):
    """The host's object of a model, as in the WIT; the fields of records are tuples."""

    @staticmethod
    def open(name: str) -> HostModel: ...

    def inputs(self) -> Sequence[Tuple[str, ElementType, List[Optional[int]]]]: ...

    def outputs(self) -> Sequence[Tuple[str, ElementType, List[Optional[int]]]]: ...

    def labels(self) -> List[str]: ...

    def runtime(self) -> str: ...

    def run(self, inputs: List[Tuple[str, HostTensor]]) -> List[Tuple[str, HostTensor]]: ...

    def detect(
        self, frame: Frame, options: DetectOptions
    ) -> Sequence[Tuple[int, str, float, float, float, float, float]]: ...


# Stands for `_gleaner` while `gleaner.testing` runs a lambda.
_local: Any = None


def _host() -> Any:
    """Returns the module with the host's classes ``Tensor`` and ``Model``."""
    if _local is not None:
        return _local
    try:
        return importlib.import_module("_gleaner")
    except ImportError:
        raise InferenceError(
            "models run only in a Gleaner host: use gleaner replay, or gleaner.testing",
            "unavailable",
        ) from None
