"""Tests tensors of a lambda in the real host."""

from __future__ import annotations


from hosted import GREY, Hosted


class Tensors(Hosted):
    def test_arrays_of_every_type_return_from_a_tensor(self) -> None:
        source = """
            import numpy as np
            from gleaner import Tensor

            TYPES = [
                "float32", "float16", "float64", "int8", "int16", "int32", "int64", "uint8", "bool"
            ]

            def on_event(ctx, event):
                for name in TYPES:
                    given = np.arange(6).astype(name).reshape(2, 3)
                    # In the other byte order, in another order of elements, and without dimensions.
                    swapped = given.astype(given.dtype.newbyteorder())
                    for array in (given, swapped, given.T, given[1, 1]):
                        tensor = Tensor.from_values(array)
                        assert tensor.element == ("boolean" if name == "bool" else name), tensor
                        assert tensor.shape == list(array.shape), tensor
                        assert tensor.size == array.nbytes, tensor
                        found = tensor.array()
                        assert found.dtype == given.dtype and not found.flags.writeable
                        np.testing.assert_array_equal(found, array)
                        np.testing.assert_array_equal(np.asarray(tensor), array)
                        assert tensor.read(1, 9) == found.tobytes()[1:10]
                assert Tensor.from_values([[1.5], [2]]).array().tolist() == [[1.5], [2.0]]
        """
        self.replay(source, [GREY])

    def test_an_array_outlives_its_tensor_and_keeps_its_values(self) -> None:
        source = """
            import gc
            import numpy as np
            from gleaner import Tensor

            def on_event(ctx, event):
                tensor = Tensor.create("int16", [2, 2])
                zeros = tensor.array()
                tensor.write(2, b"\\x01\\x02")
                tensor.write(4, memoryview(np.array([7, -1], "<i2")))
                array = tensor.array()
                del tensor
                gc.collect()
                others = [Tensor.create("int16", [2, 2]) for _ in range(9)]
                assert array.tolist() == [[0, 513], [7, -1]] and others, array
                assert zeros.tolist() == [[0, 0], [0, 0]], zeros
        """
        self.replay(source, [GREY])

    def test_refused_tensors_have_a_kind(self) -> None:
        source = """
            import numpy as np
            from gleaner import InferenceError, Preprocess, Tensor

            def refused(call, *arguments):
                try:
                    call(*arguments)
                except InferenceError as error:
                    assert str(error), "a refusal has a message"
                    return error.kind

            def on_event(ctx, event):
                tensor, frame = Tensor.create("uint8", [4]), event.as_frame()
                kinds = [
                    refused(Tensor.create, "float32", [1] * 9),
                    refused(Tensor.create, "float32", [2, 0]),
                    refused(Tensor.create, "float64", [2**32 - 1] * 8),
                    refused(Tensor.from_values, np.zeros(2, np.uint16)),
                    refused(Tensor.from_values, ["text"]),
                    refused(Tensor.from_frame, frame, Preprocess(0, 8)),
                    refused(tensor.write, 1, bytes(4)),
                    refused(tensor.write, 2**64 - 1, b""),
                ]
                assert kinds == ["wrong-input"] * 8, kinds
        """
        self.replay(source, [GREY])
