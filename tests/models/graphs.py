"""Small random graphs of the operators that detectors and classifiers use, always the same."""
import collections

import numpy as np
from onnx import TensorProto, helper, numpy_helper

SPECIAL = [np.nan, np.inf, -np.inf, 0.0, -0.0, 0.5, -0.5, 1.5, 2.5, -1.0, 1.0, 3.0]
FLOAT_OPERATORS = (
    "Abs Ceil Floor Round Sign Relu LeakyRelu Sigmoid HardSigmoid HardSwish Tanh Exp Erf Softplus "
    "Softsign Elu Neg Sqrt Reciprocal Log IsNaN IsInf Identity Cos Sin").split()
PAIRS = "Add Sub Mul Div Pow Max Min Greater Less Equal GreaterOrEqual PRelu".split()
REDUCTIONS = "Max Min Mean Sum Prod L1 L2 SumSquare LogSumExp".split()


class Maker:
    def __init__(self, seed):
        self.random = np.random.default_rng(seed)
        self.made, self.counts = [], collections.Counter()

    def floats(self, *shape):
        return self.random.normal(0, 2, shape).astype(np.float32)

    def few(self, *shape, dtype=np.float32):
        """Values of which many are equal."""
        return self.random.integers(-2, 3, shape).astype(dtype)

    def add(self, name, operator, inputs, constants=(), opset=17, outputs=1, **attributes):
        """Adds a graph of one node, whose inputs are given first and constants follow."""
        node = helper.make_node(
            operator, [f"x{i}" for i in range(len(inputs))]
            + ["" if it is None else f"c{i}" for i, it in enumerate(constants)],
            [f"y{i}" for i in range(outputs)], **attributes)
        self.graph(name, [node], inputs, {f"c{i}": it for i, it in enumerate(constants)
                                          if it is not None}, opset, outputs)

    def graph(self, name, nodes, inputs, constants, opset=17, outputs=1):
        values = [helper.make_tensor_value_info(
            f"x{i}", helper.np_dtype_to_tensor_dtype(it.dtype), it.shape)
            for i, it in enumerate(inputs)]
        made = [helper.make_empty_tensor_value_info(f"y{i}") for i in range(outputs)]
        weights = [numpy_helper.from_array(np.asarray(it), key) for key, it in constants.items()]
        graph = helper.make_graph(nodes, "g", values, made, weights)
        model = helper.make_model(graph, ir_version=8,
                                  opset_imports=[helper.make_opsetid("", opset)])
        # The types of the outputs: as the checks of a model need.
        from onnx.shape_inference import infer_shapes
        inferred = infer_shapes(model)
        if all(it.type.tensor_type.elem_type for it in inferred.graph.output):
            model = inferred
        else:
            for it in model.graph.output:
                it.type.tensor_type.elem_type = TensorProto.FLOAT
        self.counts[name] += 1
        self.made.append((f"{name}#{self.counts[name]}", model, inputs))


def cases():
    """Yields name, model and inputs."""
    it = Maker(43)
    special = np.array(SPECIAL, np.float32).reshape(1, 3, 4)
    for operator in FLOAT_OPERATORS:
        it.add(operator.lower(), operator, [special])
    for operator in PAIRS:
        it.add(operator.lower(), operator, [special, special[..., ::-1].copy()])
        it.add(operator.lower() + "_broadcast", operator, [it.floats(2, 3, 4), it.floats(4)])
    for operator in ["Div", "Mod", "Add", "Mul", "Sub", "Pow"]:
        numbers = it.random.integers(1, 5, (2, 6)).astype(np.int64)
        it.add(operator.lower() + "_int", operator, [it.few(2, 6, dtype=np.int64), numbers])
    it.add("mod_float", "Mod", [it.floats(8), it.floats(8)], fmod=1)
    for low, high in [(0, 6), (-1, None), (None, 1), (2, -2)]:
        limits = [None if v is None else np.float32(v) for v in (low, high)]
        it.add("clip", "Clip", [special], limits)
    it.add("clip_old", "Clip", [special], opset=7, min=0.0, max=6.0)
    for operator in ["Softmax", "LogSoftmax", "Hardmax"]:
        for opset in [7, 9, 11, 12, 13, 17]:
            for axis in [None, 0, 1, -1]:
                attributes = {} if axis is None else {"axis": axis}
                it.add(f"{operator.lower()}_opset{opset}", operator, [it.floats(2, 3, 4)],
                       opset=opset, **attributes)
    it.add("softmax_image", "Softmax", [it.floats(1, 5, 1, 1)], opset=11, axis=1)
    it.add("softmax_special", "Softmax", [special], axis=-1)
    for operator in ["ArgMax", "ArgMin"]:
        for dtype in [np.float32, np.int32, np.uint8]:
            it.add(operator.lower() + "_ties", operator, [it.few(2, 9, dtype=dtype)], axis=1)
        it.add(operator.lower(), operator, [it.floats(2, 5, 3)], axis=1, keepdims=0)
        it.add(operator.lower() + "_last", operator, [it.few(2, 9)], axis=1, select_last_index=1)
    for largest in [0, 1]:
        it.add("topk_ties", "TopK", [it.few(2, 9)], [np.array([4])], outputs=2, largest=largest)
        it.add("topk", "TopK", [special], [np.array([3])], outputs=2, largest=largest)
    for mode in ["nearest", "linear", "cubic"]:
        for transform in ["half_pixel", "asymmetric", "align_corners", "pytorch_half_pixel",
                          "tf_half_pixel_for_nn", "half_pixel_symmetric"]:
            for scale in [2.0, 0.6, 1.7]:
                scales = np.array([1, 1, scale, scale], np.float32)
                nearest = it.random.choice(
                    ["floor", "ceil", "round_prefer_floor", "round_prefer_ceil"])
                more = {"nearest_mode": str(nearest)} if mode == "nearest" else {}
                it.add(f"resize_{mode}_{transform}", "Resize", [it.floats(1, 2, 5, 7)],
                       [None, scales], mode=mode, coordinate_transformation_mode=transform, **more)
        it.add(f"resize_{mode}_sizes", "Resize", [it.floats(1, 2, 5, 7)],
               [None, None, np.array([1, 2, 9, 4])], mode=mode)
        it.add(f"resize_{mode}_antialias", "Resize", [it.floats(1, 2, 8, 8)],
               [None, None, np.array([1, 2, 3, 3])], opset=18, mode=mode, antialias=1)
    for opset, inputs in [(10, []), (11, [None])]:
        it.add(f"resize_opset{opset}", "Resize", [it.floats(1, 2, 4, 4)],
               [*inputs, np.array([1, 1, 2, 2], np.float32)], opset=opset, mode="nearest")
    for mode in ["nearest", "linear"]:
        it.add(f"upsample_{mode}", "Upsample", [it.floats(1, 2, 4, 4)],
               [np.array([1, 1, 2, 3], np.float32)], opset=9, mode=mode)
    corners = it.random.uniform(0, 8, (2, 24, 2)).astype(np.float32)
    boxes = np.concatenate([corners, corners + it.random.uniform(2, 6, (2, 24, 2))], 2)
    for batch, classes, iou, score in [(1, 1, 0.5, 0.2), (1, 3, 0.5, 0.3), (2, 2, 0.4, 0.5),
                                       (1, 2, 0.0, 0.1), (1, 1, 0.5, 2.0)]:
        scores = it.random.uniform(0, 1, (batch, classes, 24)).astype(np.float32)
        for center in [0, 1]:
            it.add("nms", "NonMaxSuppression", [boxes[:batch].astype(np.float32), scores],
                   [np.array([6]), np.float32(iou), np.float32(score)], center_point_box=center)
    for operator in ["Conv", "ConvTranspose", "MaxPool", "AveragePool", "ConvInteger"]:
        for auto_pad in ["SAME_UPPER", "SAME_LOWER", "VALID", "NOTSET"]:
            for stride, kernel, dilation in [(1, 3, 1), (2, 3, 1), (2, 2, 1), (1, 2, 1), (1, 3, 2)]:
                integer = operator == "ConvInteger"
                x = it.random.integers(0, 9, (1, 2, 8, 8)).astype(np.uint8) if integer \
                    else it.floats(1, 2, 8, 8)
                w = it.random.integers(0, 9, (2, 2, kernel, kernel)).astype(np.uint8)
                weights = [] if "Pool" in operator else [w if integer else w.astype(np.float32)]
                more = {} if auto_pad != "NOTSET" else {"pads": [1, 0, 0, 1]}
                if "Pool" not in operator or dilation > 1:
                    more["dilations"] = [dilation] * 2
                it.add(f"{operator.lower()}_{auto_pad.lower()}", operator, [x], weights,
                       opset=19, auto_pad=auto_pad, strides=[stride] * 2,
                       kernel_shape=[kernel] * 2, **more)
    for ceil_mode in [0, 1]:
        for count in [0, 1]:
            it.add("averagepool", "AveragePool", [it.floats(1, 2, 7, 6)], opset=19,
                   kernel_shape=[3, 2], strides=[2, 2], pads=[1, 1, 0, 1], ceil_mode=ceil_mode,
                   count_include_pad=count)
        it.add("maxpool", "MaxPool", [it.floats(1, 2, 7, 6)], kernel_shape=[3, 2],
               strides=[2, 3], pads=[1, 0, 1, 1], ceil_mode=ceil_mode)
    it.add("maxpool_special", "MaxPool", [special], kernel_shape=[2])
    it.add("globalmaxpool", "GlobalMaxPool", [it.floats(1, 3, 2, 4)])
    types = [TensorProto.BOOL, TensorProto.INT32, TensorProto.INT64, TensorProto.FLOAT,
             TensorProto.FLOAT16, TensorProto.DOUBLE]
    for source in [np.float32, np.int32, np.int64, np.bool_, np.uint8, np.int8, np.float16]:
        for to in types:
            x = np.array([0, 0.5, 1, 2, 3.7, 100, 0.001]).astype(source)
            it.add(f"cast_{np.dtype(source).name}", "Cast", [x], to=to)
    # What a wrong truth value becomes later.
    x = np.array([0, 2, 3], np.int32)
    to_bool = helper.make_node("Cast", ["x0"], ["b"], to=TensorProto.BOOL)
    it.graph("cast_bool_int", [to_bool, helper.make_node("Cast", ["b"], ["y0"], to=7)], [x], {})
    it.graph("cast_bool_where", [to_bool, helper.make_node("Where", ["b", "a", "c"], ["y0"])], [x],
             {"a": np.float32(1), "c": np.float32(2)})
    for mode in ["constant", "reflect", "edge", "wrap"]:
        it.add(f"pad_{mode}", "Pad", [it.floats(1, 3, 4)], [np.array([0, 2, 1, 0, 1, 3])],
               opset=19, mode=mode)
        it.add(f"pad_{mode}_cut", "Pad", [it.floats(1, 3, 4)], [np.array([0, -1, 1, 0, 1, -2])],
               opset=19, mode=mode)
    shapes = [((2, 3, 4), (4,)), ((1, 2, 4, 3), (3,)), ((3,), (2, 3, 4)), ((4,), (4,)),
              ((2, 1, 3, 4), (5, 4, 2)), ((3, 4), (4,)), ((1, 1, 2, 3), (1, 1, 3, 2))]
    for a, b in shapes:
        it.add("matmul", "MatMul", [it.floats(*a), it.floats(*b)])
    for reduction in REDUCTIONS:
        for axes in [[1], [0, 2], None]:
            more = {} if axes is None else {"axes": axes}
            it.add(f"reduce{reduction.lower()}", f"Reduce{reduction}", [it.floats(2, 3, 4)],
                   opset=12, **more)
        it.add(f"reduce{reduction.lower()}_special", f"Reduce{reduction}", [special], opset=12,
               axes=[2], keepdims=0)
    it.add("where", "Where", [it.few(2, 4) > 0, it.floats(2, 4), it.floats(4)])
    it.add("gather", "Gather", [it.floats(5, 3)], [np.array([0, -1, 4])])
    it.add("slice", "Slice", [it.floats(5, 6)],
           [np.array([-1, 1]), np.array([-9, 2**62]), np.array([0, 1]), np.array([-2, 2])])
    it.add("constant_wide", "Add", [it.few(3, dtype=np.int64)], [np.array([3_000_000_000])])
    it.add("cumsum", "CumSum", [it.floats(3, 4)], [np.array(1)], exclusive=1, reverse=1)
    for dtype in [np.uint8, np.int8]:
        scale, zero = np.float32(0.5), dtype(3)
        it.add("quantize", "QuantizeLinear", [special[..., 3:]], [scale, zero])
        it.add("dequantize", "DequantizeLinear", [it.few(2, 5, dtype=dtype)], [scale, zero])
    it.add("dynamicquantize", "DynamicQuantizeLinear", [it.floats(9)], outputs=3)
    it.add("batchnorm", "BatchNormalization", [it.floats(1, 3, 2, 2)],
           [it.floats(3), it.floats(3), it.floats(3), np.abs(it.floats(3))])
    it.add("instancenorm", "InstanceNormalization", [it.floats(2, 3, 4)],
           [it.floats(3), it.floats(3)])
    it.add("depthtospace", "DepthToSpace", [it.floats(1, 8, 2, 3)], blocksize=2, mode="CRD")
    it.add("gemm", "Gemm", [it.floats(3, 2)], [it.floats(4, 3), it.floats(4)], transA=1, transB=1,
           alpha=0.5, beta=2.0)
    it.add("gridsample", "GridSample", [it.floats(1, 2, 4, 4)],
           [it.random.uniform(-1.2, 1.2, (1, 3, 3, 2)).astype(np.float32)])
    it.add("nonzero", "NonZero", [it.few(3, 4)])
    it.add("onehot", "OneHot", [np.array([0, -1, 5, 2])],
           [np.array(4), np.array([0.0, 1.0], np.float32)])
    it.add("scatternd", "ScatterND", [it.floats(4, 2)],
           [np.array([[1], [1], [3]]), it.floats(3, 2)])
    reports(it)
    return it.made


def reports(it):
    """Small models of public reports of wrong results."""
    # microsoft/onnxruntime#12098 and #28310: nearest from 26 to 64 pixels.
    row = np.arange(26, dtype=np.float32).reshape(1, 1, 1, 26)
    it.add("report_ort28310", "Resize", [row], [None, np.array([1, 1, 1, 64 / 26], np.float32)],
           mode="nearest", nearest_mode="round_prefer_ceil")
    # microsoft/onnxruntime#11496: cubic to one pixel.
    it.add("report_ort11496", "Resize", [it.floats(1, 1, 4, 4)],
           [None, None, np.array([1, 1, 1, 1])], mode="cubic")
    # microsoft/onnxruntime#8880: Xor of one element.
    it.add("report_ort8880", "Xor", [np.array([True])], [np.array([False])])
    # microsoft/onnxruntime#10491: Softplus of a large negative number.
    it.add("report_ort10491", "Softplus", [np.array([-12.3392, -20, 90], np.float32)])
    # microsoft/onnxruntime#2434: TopK of a thousand values of which most are equal.
    few = np.zeros((1, 1000), np.float32)
    few[0, :6] = [0.1, 0.3, 0.02, 0.45, 0.08, 0.05]
    it.add("report_ort2434", "TopK", [few], [np.array([9])], outputs=2)
    # NVIDIA/TensorRT#4512: Or of a number cast to boolean.
    cast = helper.make_node("Cast", ["x0"], ["b"], to=TensorProto.BOOL)
    it.graph("report_tensorrt4512", [cast, helper.make_node("Or", ["b", "c"], ["y0"])],
             [np.array([0.25, 0, 2], np.float32)], {"c": np.array([False])})
