"""Policies as ONNX models, which other languages and runtimes read."""

import importlib.util
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mtjax.names import InputError
from mtjax.saved.standalone import OPERATIONS, product_equation, spread_sizes

_OPSET = 18  # of ONNX's operators: the first whose reductions all take their axes as inputs
_IR = 8  # the file format that came with it, so that older runtimes read the file
_SAME = {  # operations that ONNX has under another name, with the same arguments
    **{name: name.capitalize() for name in ("sign", "floor", "sqrt", "exp", "log", "sin", "cos", "tanh", "abs")},
    **{name: name.capitalize() for name in ("add", "sub", "mul", "div", "max", "min", "pow", "neg")},
    **{"logistic": "Sigmoid", "lt": "Less", "le": "LessOrEqual", "gt": "Greater", "ge": "GreaterOrEqual"},
    **{"eq": "Equal", "stop_gradient": "Identity", "copy": "Identity"},
}
_LOGICAL = {"and": "And", "or": "Or", "not": "Not", "max": "Or", "min": "And"}  # of operations on bools
_REDUCED = {"sum": "ReduceSum", "max": "ReduceMax", "min": "ReduceMin", "prod": "ReduceProd"}


def require_onnx() -> None:
    """Raise InputError unless the package onnx is installed."""
    if importlib.util.find_spec("onnx") is None:
        raise InputError("a policy is exported to ONNX by the package onnx: pip install 'mtjax[onnx]'")


def write(
    program: dict[str, Any], constants: Sequence[np.ndarray], inputs: dict[str, Any], meta: dict[str, Any], file: Path
) -> None:
    """Write the steps of a policy, as ``steps.steps_of`` returns them, as an ONNX model.

    Args:
        inputs: shapes and types by name, in their order. Those that the policy does not read are left out.
        meta: the model's metadata. Its ``about`` is also the model's description.

    Raises:
        InputError: an operation has no counterpart in ONNX.
    """
    import onnx
    from onnx import helper

    graph = _Graph(program, constants, inputs)
    put = lambda name, x: helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(x.dtype), x.shape)
    graph.node("Identity", [graph.name(program["result"])], "action")
    used = {name for node in graph.nodes for name in node.input}
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            f"{meta['agent']} on {meta['env']}",
            [put(name, x) for name, x in inputs.items() if name in used],
            [put("action", graph.values[program["result"]])],
            [tensor for tensor in graph.tensors if tensor.name in used],
            doc_string=meta["about"],
        ),
        opset_imports=[helper.make_opsetid("", _OPSET)],
        ir_version=_IR,
        producer_name="mtjax",
        doc_string=meta["about"],
    )
    helper.set_model_props(model, {"mtjax": json.dumps(meta)})
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(file))


class _Graph:
    """Collects the nodes of a model. What does not depend on the inputs is computed here, once."""

    def __init__(self, program: dict[str, Any], constants: Sequence[np.ndarray], inputs: dict[str, Any]):
        self.nodes, self.tensors, self.shown = [], [], {}
        zeros = (np.zeros(x.shape, x.dtype) for x in inputs.values())
        self.values = dict(enumerate((*constants, *zeros)))  # of the inputs' successors only shapes and types matter
        self.names = dict(enumerate(inputs, len(constants)))
        for operation, arguments, results, settings in program["steps"]:
            self._step(operation, arguments, results, settings)

    def _step(self, operation: str, arguments: list[int], results: list[int], settings: dict[str, Any]) -> None:
        values = [self.values[i] for i in arguments]
        with np.errstate(all="ignore"):
            found = OPERATIONS[operation](*values, **settings)
        found = found if isinstance(found, list) else [found]
        self.values.update(zip(results, map(np.asarray, found), strict=True))
        if any(i in self.names for i in arguments):
            names = self._emit(operation, [self.name(i) for i in arguments], values, self.values[results[0]], settings)
            self.names.update(zip(results, names, strict=True))

    def name(self, number: int) -> str:
        """Return the name of a value; one that does not depend on the inputs becomes part of the model."""
        return self.names.get(number) or self.constant(self.values[number])

    def constant(self, value: Any, dtype: Any = None) -> str:
        from onnx import numpy_helper

        value = np.asarray(value, dtype)
        content = (value.tobytes(), value.shape, value.dtype)
        if content not in self.shown:
            self.shown[content] = f"constant_{len(self.shown)}"
            self.tensors.append(
                numpy_helper.from_array(np.ascontiguousarray(value).reshape(value.shape), self.shown[content])
            )
        return self.shown[content]

    def node(self, kind: str, inputs: Sequence[str], output: str = "", **attributes: Any) -> str:
        from onnx import helper

        output = output or f"value_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output

    def several(self, kind: str, inputs: Sequence[str], count: int, **attributes: Any) -> list[str]:
        from onnx import helper

        outputs = [f"value_{len(self.nodes)}_{i}" for i in range(count)]
        self.nodes.append(helper.make_node(kind, inputs, outputs, **attributes))
        return outputs

    def transposed(self, name: str, value: np.ndarray, order: Sequence[int]) -> str:
        """Return the name of a value with its axes in another order. Of a constant this is another constant."""
        if name in self.shown.values():
            return self.constant(np.transpose(value, order))
        return self.node("Transpose", [name], perm=list(order))

    def cast(self, name: str, dtype: Any) -> str:
        from onnx import helper

        return self.node("Cast", [name], to=helper.np_dtype_to_tensor_dtype(np.dtype(dtype)))

    def indices(self, values: Any) -> str:
        return self.constant(values, np.int64)

    def _emit(
        self, operation: str, names: list[str], values: list[np.ndarray], result: Any, settings: Any
    ) -> list[str]:
        """Write the nodes of an operation; return the names of its results."""
        bools = values[0].dtype == bool
        if operation == "optimization_barrier":
            return names
        if operation == "split":
            return self.several(
                "Split", [names[0], self.indices(settings["sizes"])], len(settings["sizes"]), axis=settings["axis"]
            )
        if operation == "unstack":
            axis, count = settings["axis"], values[0].shape[settings["axis"]]
            apart = self.several("Split", [names[0], self.indices([1] * count)], count, axis=axis)
            return [self.node("Squeeze", [name, self.indices([axis])]) for name in apart]
        if operation == "top_k":
            top = self.several("TopK", [names[0], self.indices([settings["k"]])], 2, axis=settings["axis"])
            return [top[0], self.cast(top[1], np.int32)]
        if bools and operation in _LOGICAL:
            return [self.node(_LOGICAL[operation], names)]
        if operation in _SAME:
            return [self.node(_SAME[operation], names)]
        if operation in _OTHERS:
            return [_OTHERS[operation](self, names, values, result, **settings)]
        if operation.startswith("reduce_"):
            return [self._reduced(operation.removeprefix("reduce_"), names[0], values[0].dtype, settings["axes"])]
        raise InputError(f"export to ONNX knows no operation {operation!r}")

    def _reduced(self, kind: str, name: str, dtype: Any, axes: Sequence[int]) -> str:
        if kind in ("and", "or"):
            number = self.cast(name, np.int32)
            return self.cast(self._reduced({"and": "min", "or": "max"}[kind], number, np.int32, axes), bool)
        return self.node(_REDUCED[kind], [name, self.indices(axes)], keepdims=0)


def _broadcast(graph: _Graph, names, values, result, shape, broadcast_dimensions):
    sizes = spread_sizes(values[0], len(shape), broadcast_dimensions)
    placed = graph.node("Reshape", [names[0], graph.indices(sizes)])
    return graph.node("Expand", [placed, graph.indices(shape)])


def _reshape(graph: _Graph, names, values, result, **_):
    return graph.node("Reshape", [names[0], graph.indices(result.shape)])


def _select(graph: _Graph, names, values, result):
    which, *cases = names
    if values[0].dtype == bool:
        return graph.node("Where", [which, cases[1], cases[0]])
    chosen = cases[0]
    for i, case in enumerate(cases[1:], 1):
        chosen = graph.node("Where", [graph.node("Equal", [which, graph.constant(i, values[0].dtype)]), case, chosen])
    return chosen


def _slice(graph: _Graph, names, values, result, start_indices, limit_indices, strides):
    axes = range(values[0].ndim)
    bounds = (start_indices, limit_indices, axes, strides or [1] * len(axes))
    return graph.node("Slice", [names[0], *map(graph.indices, map(list, bounds))])


def _dynamic_slice(graph: _Graph, names, values, result, slice_sizes):
    one = lambda name: graph.node("Reshape", [graph.cast(name, np.int64), graph.indices([1])])
    begin = graph.node("Concat", [one(name) for name in names[1:]], axis=0)
    last = np.subtract(values[0].shape, slice_sizes)
    begin = graph.node("Max", [graph.node("Min", [begin, graph.indices(last)]), graph.indices([0] * len(last))])
    end = graph.node("Add", [begin, graph.indices(slice_sizes)])
    return graph.node("Slice", [names[0], begin, end])


def _dot(graph: _Graph, names, values, result, dimension_numbers):
    a, b = (x.ndim for x in values)
    return graph.node("Einsum", names, equation=product_equation(a, b, dimension_numbers))


def _convolution(graph: _Graph, names, values, result, window_strides, padding, rhs_dilation, dimension_numbers):
    of_x, of_kernel, of_result = dimension_numbers  # each puts channels before space, as ONNX does
    given = graph.transposed(names[0], values[0], of_x), graph.transposed(names[1], values[1], of_kernel)
    sides = [side for both in zip(*padding, strict=True) for side in both]  # all beginnings, then all ends
    found = graph.node("Conv", given, strides=window_strides, pads=sides, dilations=rhs_dilation)
    return graph.node("Transpose", [found], perm=np.argsort(of_result).tolist())


def _largest_in_windows(
    graph: _Graph, names, values, result, window_dimensions, window_strides, padding, window_dilation
):
    settings = list(zip(window_dimensions, window_strides, padding, window_dilation, strict=True))
    space = [i for i, (size, step, *_) in enumerate(settings) if (size, step) != (1, 1)]
    order = [i for i in range(len(settings)) if i not in space] + space
    apart = lambda shape: [1, -1, *(shape[i] for i in space)]
    found = graph.node("Transpose", names, perm=order)
    found = graph.node("Reshape", [found, graph.indices(apart(values[0].shape))])
    sizes, steps, sides, gaps = zip(*(settings[i] for i in space), strict=True)
    sides = [side for both in zip(*sides, strict=True) for side in both]
    found = graph.node("MaxPool", [found], kernel_shape=sizes, strides=steps, pads=sides, dilations=gaps)
    found = graph.node("Reshape", [found, graph.indices([result.shape[i] for i in order])])
    return graph.node("Transpose", [found], perm=np.argsort(order).tolist())


def _extreme(kind: str) -> Callable:
    def emit(graph: _Graph, names, values, result, axes, index_dtype):
        number = graph.cast(names[0], np.int32) if values[0].dtype == bool else names[0]
        return graph.cast(graph.node(kind, [number], axis=axes[0], keepdims=0), index_dtype)

    return emit


def _stack(graph: _Graph, names, values, result, axis):
    apart = [graph.node("Unsqueeze", [name, graph.indices([axis])]) for name in names]
    return graph.node("Concat", apart, axis=axis)


_OTHERS: dict[str, Callable] = {
    "log1p": lambda graph, names, values, _: graph.node(
        "Log", [graph.node("Add", [names[0], graph.constant(1, values[0].dtype)])]
    ),
    "square": lambda graph, names, *_: graph.node("Mul", [names[0], names[0]]),
    "rsqrt": lambda graph, names, *_: graph.node("Reciprocal", [graph.node("Sqrt", names)]),
    "ne": lambda graph, names, *_: graph.node("Not", [graph.node("Equal", names)]),
    "integer_pow": lambda graph, names, values, _, y: graph.node("Pow", [names[0], graph.constant(y, values[0].dtype)]),
    "convert_element_type": lambda graph, names, *_, new_dtype: graph.cast(names[0], new_dtype),
    "clamp": lambda graph, names, *_: graph.node("Min", [graph.node("Max", names[:2]), names[2]]),
    "select_n": _select,
    "broadcast_in_dim": _broadcast,
    **dict.fromkeys(("reshape", "squeeze", "expand_dims"), _reshape),
    "transpose": lambda graph, names, *_, permutation: graph.node("Transpose", names, perm=permutation),
    "concatenate": lambda graph, names, *_, dimension: graph.node("Concat", names, axis=dimension),
    "stack": _stack,
    "slice": _slice,
    "dynamic_slice": _dynamic_slice,
    "dot_general": _dot,
    "conv_general_dilated": _convolution,
    "reduce_window_max": _largest_in_windows,
    "argmax": _extreme("ArgMax"),
    "argmin": _extreme("ArgMin"),
}
