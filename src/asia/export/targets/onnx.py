"""ONNX graphs of the initial state, of one sample, and of a whole simulation."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from asia.data.segment import SimulatedSegment
from asia.errors import UserError
from asia.export.model import ExportModel, Printed
from asia.export.target import Answers, missing_package
from asia.export.targets.indices import source_places, values_of
from asia.lowering.program import LoweredModel, Node, Program, Shape

_OPSET, _IR = 17, 9
_NAMES = {
    "neg": "Neg", "abs": "Abs", "sign": "Sign", "floor": "Floor", "sqrt": "Sqrt", "exp": "Exp",
    "log": "Log", "tanh": "Tanh", "sin": "Sin", "cos": "Cos", "tan": "Tan", "asin": "Asin",
    "acos": "Acos", "atan": "Atan", "add": "Add", "sub": "Sub", "mul": "Mul", "div": "Div",
    "max": "Max", "min": "Min", "pow": "Pow", "matmul": "MatMul",
}  # fmt: skip
_COMPARED = {
    "lt": "Less",
    "le": "LessOrEqual",
    "gt": "Greater",
    "ge": "GreaterOrEqual",
    "eq": "Equal",
}
_REDUCED = {"rmax": "ReduceMax", "rmin": "ReduceMin", "rprod": "ReduceProd"}


class OnnxTarget:
    """Target `onnx`: `initial.onnx`, `step.onnx`, `simulate.onnx`."""

    name = "onnx"
    usage = """```python
import onnxruntime
simulate = onnxruntime.InferenceSession("simulate.onnx")
(y_hat,) = simulate.run(None, {"past_u": past_u, "past_y": past_y, "u": u})  # float64
```
`initial.onnx` gives the states `x0`, `x1`, ... at the first sample; `step.onnx` takes them with
`u` (nu,) and gives `y` (ny,) and the states at the next sample, `x0_next`, ..."""

    def missing(self) -> str | None:
        """Return a sentence if onnx or onnxruntime is not installed."""
        return missing_package("onnx", "onnxruntime")

    def print(self, model: ExportModel) -> Printed:
        """Print the files. Raises UserError for an operation that ONNX does not have."""
        low = model.lowered
        states = [f"x{i}" for i in range(len(low.states))]
        after = [f"{x}_next" for x in states]
        window = ["past_u", "past_y", "u"]
        return Printed(
            {
                "initial.onnx": _model("initial", low.initial, window, states, model),
                "step.onnx": _model("step", low.step, [*states, "u"], ["y", *after], model),
                "simulate.onnx": _simulation(low, model),
            }
        )

    def run(self, folder: Path, windows: Sequence[SimulatedSegment]) -> list[Answers] | str:
        """Simulate with onnxruntime, a window at a time."""
        import onnxruntime as ort

        options = ort.SessionOptions()
        options.intra_op_num_threads, options.log_severity_level = 1, 3
        session = ort.InferenceSession(
            str(folder / "simulate.onnx"), options, providers=["CPUExecutionProvider"]
        )
        expected = {i.name for i in session.get_inputs()}
        y_hat: list[Any] = []
        begin = time.perf_counter()
        for w in windows:
            given = {"past_u": w.past_u, "past_y": w.past_y, "u": w.u}
            y_hat.append(session.run(None, {k: v for k, v in given.items() if k in expected})[0])
        return [Answers("double", tuple(y_hat), time.perf_counter() - begin)]


class _Graph:
    """Nodes and constants of one graph; a graph inside another one can use the outer names."""

    def __init__(self, prefix: str = "") -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self._prefix = prefix
        self._count = 0

    def name(self) -> str:
        self._count += 1
        return f"{self._prefix}v{self._count}"

    def add(self, op: str, *read: str, outputs: Sequence[str] | None = None, **attrs: Any) -> str:
        from onnx import helper

        names = [self.name()] if outputs is None else list(outputs)
        self.nodes.append(helper.make_node(op, list(read), names, **attrs))
        return names[0]

    def constant(self, array: Any) -> str:
        from onnx import numpy_helper

        name = self.name()
        self.constants.append(numpy_helper.from_array(np.array(array, order="C"), name))
        return name

    def run(self, program: Program, inputs: Sequence[str]) -> list[str]:
        """Print a program and return the names of its outputs."""
        return values_of(program, inputs, self.constant, self._value, self._loop)

    def _integers(self, values: Sequence[int]) -> str:
        return self.constant(np.array(values, np.int64))

    def _value(self, node: Node, read: list[str], shapes: list[Shape]) -> str:
        op, a = node.op, node.attrs
        if op in _NAMES:
            return self.add(_NAMES[op], *read)
        if op in _COMPARED or op == "ne":
            return self._number(self.add(_COMPARED.get(op, "Equal"), *read), flip=op == "ne")
        if op == "isfinite":
            bad = self.add("Or", self.add("IsNaN", read[0]), self.add("IsInf", read[0]))
            return self._number(bad, flip=True)
        if op == "select":
            zero = self.add("Equal", read[0], self.constant(np.float64(0.0)))
            return self.add("Where", zero, read[2], read[1])
        if op in ("log1p", "expm1", "sinh", "cosh"):
            one, half = self.constant(np.float64(1.0)), self.constant(np.float64(0.5))
            if op == "log1p":
                return self.add("Log", self.add("Add", one, read[0]))
            if op == "expm1":
                return self.add("Sub", self.add("Exp", read[0]), one)
            up, down = self.add("Exp", read[0]), self.add("Exp", self.add("Neg", read[0]))
            return self.add("Mul", half, self.add("Sub" if op == "sinh" else "Add", up, down))
        if op == "reshape":
            return self.add("Reshape", read[0], self._integers(node.shape))
        if op == "concat":
            return self.add("Concat", *read, axis=a[0])
        if op == "pad":
            return self.add("Pad", read[0], self._integers(a), read[1])
        if op == "rsum":
            return self.add("ReduceSum", read[0], self._integers(a), keepdims=0)
        if op in _REDUCED:
            return self.add(_REDUCED[op], read[0], axes=list(a), keepdims=0)
        if op == "broadcast" and not shapes[0]:
            return self.add("Expand", read[0], self._integers(node.shape))
        if op in ("broadcast", "slice", "transpose", "pick"):
            flat = self.add("Reshape", read[0], self._integers((-1,)))
            places = self.constant(source_places(node, shapes[0]).reshape(node.shape))
            return self.add("Gather", flat, places, axis=0)
        raise UserError(f"--to onnx: ONNX has no {op}; use another target, such as c")

    def _number(self, truth: str, *, flip: bool) -> str:
        from onnx import TensorProto

        if flip:
            truth = self.add("Not", truth)
        return self.add("Cast", truth, to=TensorProto.DOUBLE)

    def _loop(self, node: Node, read: list[str], shapes: list[Shape]) -> list[str]:
        assert node.body is not None
        length, same, carried = node.attrs
        carry = read[same : same + carried]
        inner = _Graph(f"{self.name()}_")
        iteration, going = inner.name(), inner.name()
        given = [inner.name() for _ in carry]
        rows = [inner.add("Gather", r, iteration, axis=0) for r in read[same + carried :]]
        found = inner.run(node.body, [*read[:same], *given, *rows])
        graph = inner.loop_body(iteration, going, given, found, node.body.output_shapes)
        names = [self.name() for _ in found]
        count, true = self.constant(np.int64(length)), self.constant(np.bool_(True))
        self.add("Loop", count, true, *carry, outputs=names, body=graph)
        return names

    def loop_body(
        self, iteration: str, going: str, given: list[str], found: list[str],
        shapes: Sequence[Shape],
    ) -> Any:  # fmt: skip
        """Body of a Loop: (iteration, condition, carried) -> (condition, carried, stacked)."""
        from onnx import TensorProto, helper

        info = helper.make_tensor_value_info
        # Each output needs a separate name.
        ends = [self.add("Identity", name) for name in found]
        still = self.add("Identity", going)
        inputs = [info(iteration, TensorProto.INT64, []), info(going, TensorProto.BOOL, [])]
        carried = zip(given, shapes, strict=False)
        inputs += [info(n, TensorProto.DOUBLE, list(s)) for n, s in carried]
        outputs = [info(still, TensorProto.BOOL, [])]
        outputs += [info(n, TensorProto.DOUBLE, list(s)) for n, s in zip(ends, shapes, strict=True)]
        return helper.make_graph(self.nodes, f"{going}_body", inputs, outputs, self.constants)


def _model(
    name: str, program: Program, inputs: list[str], outputs: list[str], model: ExportModel
) -> bytes:
    graph = _Graph()
    found = graph.run(program, inputs)
    for end, value in zip(outputs, found, strict=True):
        graph.add("Identity", value, outputs=[end])
    shapes = zip(outputs, program.output_shapes, strict=True)
    return _bytes(name, graph, list(zip(inputs, program.inputs, strict=True)), list(shapes), model)


def _simulation(low: LoweredModel, model: ExportModel) -> bytes:
    """Graph of all samples of u (H, nu), with H open."""
    graph = _Graph()
    zero = graph.constant(np.int64(0))
    first = graph.add("Gather", "u", zero, axis=0)
    states = graph.run(low.initial, ["past_u", "past_y", first])
    inner = _Graph("s_")
    iteration, going = inner.name(), inner.name()
    given = [inner.name() for _ in states]
    now = inner.add("Gather", "u", iteration, axis=0)
    y, *after = inner.run(low.step, [*given, now])
    shapes = [*low.states, (low.ny,)]
    body = inner.loop_body(iteration, going, given, [*after, y], shapes)
    length = graph.add("Gather", graph.add("Shape", "u"), zero, axis=0)
    names = [*(graph.name() for _ in states), "y_hat"]
    true = graph.constant(np.bool_(True))
    graph.add("Loop", length, true, *states, outputs=names, body=body)
    inputs: list[tuple[str, Any]] = [
        ("past_u", (low.n_past_u, low.nu)),
        ("past_y", (low.n_past_y, low.ny)),
        ("u", ("H", low.nu)),
    ]
    return _bytes("simulate", graph, inputs, [("y_hat", ("H", low.ny))], model)


def _bytes(
    name: str, graph: _Graph, inputs: Sequence[Any], outputs: Sequence[Any], model: ExportModel
) -> bytes:
    import onnx
    from onnx import TensorProto, helper

    def info(signal: Any) -> Any:
        return helper.make_tensor_value_info(signal[0], TensorProto.DOUBLE, list(signal[1]))

    made = helper.make_graph(
        graph.nodes, name, [info(i) for i in inputs], [info(o) for o in outputs], graph.constants
    )
    whole = helper.make_model(
        made, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR,
        producer_name="asia",
    )  # fmt: skip
    helper.set_model_props(
        whole,
        {
            "sampling_time": repr(model.sampling_time),
            "inputs": ", ".join(s.label for s in model.inputs),
            "outputs": ", ".join(s.label for s in model.outputs),
        },
    )
    onnx.checker.check_model(whole, full_check=True)
    return whole.SerializeToString()
