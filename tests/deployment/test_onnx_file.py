"""ONNX files made to do harm: numbers that are not finite, weights elsewhere, graphs without an end."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

from cotap import deploy
from cotap.deployment import onnx_file


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("raw", [True, False])
def test_an_onnx_file_with_weights_that_are_not_finite_is_refused_by_name(
    policy_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], value: float, raw: bool
):
    """In every weight that it has, however it is written."""
    proto = onnx.load(policy_file)
    for i, weight in enumerate(proto.graph.initializer):
        numbers = onnx.numpy_helper.to_array(weight)
        if numbers.dtype.kind != "f":
            continue
        changed = onnx.ModelProto.FromString(proto.SerializeToString())
        numbers = numbers.copy()
        numbers.reshape(-1)[-1] = value
        made = onnx.numpy_helper.from_array(numbers, weight.name)
        if not raw:
            made = onnx.helper.make_tensor(weight.name, weight.data_type, weight.dims, numbers.reshape(-1).tolist())
        changed.graph.initializer[i].CopyFrom(made)
        onnx.save(changed, tmp_path / "bad.onnx")
        assert deploy.main(["--policy", str(tmp_path / "bad.onnx")]) == 2
        said = capsys.readouterr().err
        assert "bad.onnx' cannot be read as ONNX: its weight " in said
        assert said.endswith("is not finite\n")


def graph_with(good: Path, *nodes: onnx.NodeProto, **parts: Any) -> onnx.ModelProto:
    """The good policy with more nodes, which nothing reads, and other parts of its graph."""
    proto = onnx.load(good)
    proto.graph.node.extend(nodes)
    for name, values in parts.items():
        getattr(proto.graph, name).extend(values)
    return proto


def constant(**attribute: Any) -> onnx.NodeProto:
    return onnx.helper.make_node("Constant", [], ["unread"], **attribute)


def a_tensor(values: list[float], kind: int = onnx.TensorProto.FLOAT) -> onnx.TensorProto:
    return onnx.helper.make_tensor("t", kind, [len(values)], values)


def merged(good: Path) -> bytes:
    """A weight in two parts, which readers join: not finite in the one, of which the other says the kind."""
    tensor = onnx.TensorProto(dims=[1], raw_data=np.float32(math.nan).tobytes())
    attribute = onnx.AttributeProto(name="value", type=onnx.AttributeProto.TENSOR, t=onnx.TensorProto(data_type=6))
    attribute.t.MergeFrom(tensor)
    second = onnx.TensorProto(data_type=1).SerializeToString()
    written = attribute.SerializeToString() + b"\x2a" + bytes([len(second)]) + second
    node = onnx.NodeProto(op_type="Constant", output=["unread"]).SerializeToString()
    node += b"\x2a" + bytes([len(written)]) + written
    graph = b"\x0a" + bytes([len(node)]) + node
    data = good.read_bytes() + b"\x3a" + bytes([len(graph)]) + graph
    assert math.isnan(onnx.numpy_helper.to_array(onnx.ModelProto.FromString(data).graph.node[-1].attribute[0].t)[0])
    return data


NAN_GRAPHS: dict[str, Any] = {
    "constant": lambda good: graph_with(good, constant(value=a_tensor([1.0, math.nan]))),
    "number": lambda good: graph_with(good, constant(value_float=math.inf)),
    "numbers": lambda good: graph_with(good, constant(value_floats=[0.0, math.nan])),
    "sparse": lambda good: graph_with(good, constant(sparse_value=onnx.helper.make_sparse_tensor(
        a_tensor([math.nan]), onnx.helper.make_tensor("i", onnx.TensorProto.INT64, [1], [0]), [4]))),
    "sparse weight": lambda good: graph_with(good, sparse_initializer=[onnx.helper.make_sparse_tensor(
        a_tensor([math.nan]), onnx.helper.make_tensor("i", onnx.TensorProto.INT64, [1], [0]), [4])]),
    "double": lambda good: graph_with(good, initializer=[a_tensor([math.nan], onnx.TensorProto.DOUBLE)]),
    "half": lambda good: graph_with(good, initializer=[a_tensor([math.nan], onnx.TensorProto.FLOAT16)]),
    "brain": lambda good: graph_with(good, initializer=[a_tensor([math.nan], onnx.TensorProto.BFLOAT16)]),
    "merged": merged,
}  # fmt: skip


@pytest.mark.parametrize("where", NAN_GRAPHS)
def test_no_number_of_an_onnx_graph_is_anything_but_finite(
    policy_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], where: str
):
    """Wherever a graph may have one, which is in more places than its list of weights."""
    made = NAN_GRAPHS[where](policy_file)
    (tmp_path / "bad.onnx").write_bytes(made if isinstance(made, bytes) else made.SerializeToString())
    assert deploy.main(["--policy", str(tmp_path / "bad.onnx"), "--episode-seconds", "0.06"]) == 2
    assert re.search(
        r"bad\.onnx' cannot be read as ONNX: (its weight '.*' is|an attribute of its graph is) (not finite|of a kind)",
        capsys.readouterr().err,
    )


def test_every_place_of_a_number_in_onnx_is_known():
    """Against the format's own description, from the model down."""
    named = {"weight": "TensorProto", "sparse weight": "SparseTensorProto", "branch": "GraphProto",
             "function": "FunctionProto", "graph": "GraphProto", "node": "NodeProto",
             "attribute": "AttributeProto"}  # fmt: skip
    for kind, message in (("model", onnx.ModelProto), ("graph", onnx.GraphProto), ("node", onnx.NodeProto),
                          ("attribute", onnx.AttributeProto), ("sparse weight", onnx.SparseTensorProto)):  # fmt: skip
        fields = [f for f in message.DESCRIPTOR.fields if f.message_type and f.message_type.name in named.values()]
        assert {f.number: f.message_type.name for f in fields} == {
            number: named[part] for number, part in onnx_file._PARTS[kind].items()
        }
        assert {n for k, n in onnx_file._ONCE if k == kind} == {f.number for f in fields if not f.is_repeated}


def endless(good: Path) -> onnx.ModelProto:
    """The policy with a loop of 2^63 - 1 turns before its output."""
    body = onnx.helper.make_graph(
        [onnx.helper.make_node("Identity", ["go"], ["on"]), onnx.helper.make_node("Identity", ["x"], ["y"])],
        "body",
        [onnx.helper.make_tensor_value_info("i", onnx.TensorProto.INT64, []),
         onnx.helper.make_tensor_value_info("go", onnx.TensorProto.BOOL, []),
         onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, None)],
        [onnx.helper.make_tensor_value_info("on", onnx.TensorProto.BOOL, []),
         onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, None)],
    )  # fmt: skip
    return late(good, lambda name, out: [
        onnx.helper.make_node("Constant", [], ["turns"], value_int=2**63 - 1),
        onnx.helper.make_node("Constant", [], ["yes"], value=onnx.helper.make_tensor("b", 9, [], [True])),
        onnx.helper.make_node("Loop", ["turns", "yes", name], [out], body=body),
    ])  # fmt: skip


def late(good: Path, nodes: Callable[[str, str], list[onnx.NodeProto]]) -> onnx.ModelProto:
    """The policy with more nodes between its targets, under another name, and what it gives."""
    proto = onnx.load(good)
    for node in proto.graph.node:
        node.output[:] = ["before" if name == "joint_targets" else name for name in node.output]
    proto.graph.node.extend(nodes("before", "joint_targets"))
    return proto


def unfolding(good: Path) -> onnx.ModelProto:
    """The policy with a function that calls another twice, and so on: 2^40 nodes once unfolded."""
    proto = late(good, lambda name, out: [onnx.helper.make_node("F40", [name], [out], domain="d")])
    opset = [onnx.helper.make_opsetid("", 20), onnx.helper.make_opsetid("d", 1)]
    proto.opset_import.append(opset[1])
    for k in range(1, 41):
        nodes = [onnx.helper.make_node(f"F{k - 1}", ["x"], ["m"], domain="d"),
                 onnx.helper.make_node(f"F{k - 1}", ["m"], ["y"], domain="d")]  # fmt: skip
        proto.functions.append(onnx.helper.make_function("d", f"F{k}", ["x"], ["y"], nodes, opset))
    nodes = [onnx.helper.make_node("Identity", ["x"], ["y"])]
    proto.functions.append(onnx.helper.make_function("d", "F0", ["x"], ["y"], nodes, opset))
    return proto


def laborious(good: Path) -> onnx.ModelProto:
    """The policy after thousands of products of matrices that are made of nothing."""

    def nodes(name: str, out: str) -> list[onnx.NodeProto]:
        side = onnx.helper.make_tensor("s", onnx.TensorProto.INT64, [2], [3000, 3000])
        products = [onnx.helper.make_node("MatMul", [f"m{k}", "m0"], [f"m{k + 1}"]) for k in range(3000)]
        return [
            onnx.helper.make_node("Constant", [], ["side"], value=side),
            onnx.helper.make_node("ConstantOfShape", ["side"], ["m0"]),
            *products,
            onnx.helper.make_node("ReduceSum", ["m3000"], ["sum"], keepdims=0),
            onnx.helper.make_node("Add", [name, "sum"], [out]),
        ]

    return late(good, nodes)


@pytest.mark.parametrize(
    ("make", "said"),
    [(endless, "its graph has a loop or a branch"), (unfolding, "its graph has a function"),
     (laborious, "its first inference took more than 0.5 s")],
)  # fmt: skip
def test_an_onnx_file_that_would_never_end_is_refused(
    policy_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
    make: Callable[[Path], onnx.ModelProto], said: str,
):  # fmt: skip
    monkeypatch.setattr("cotap.deployment.policy.FIRST_S", 0.5)
    path, begin = tmp_path / "endless.onnx", time.perf_counter()
    onnx.save(make(policy_file), path)
    assert deploy.main(["--policy", str(path)]) == 2
    assert re.search(rf"endless\.onnx' cannot be (used|read as ONNX): {said}", capsys.readouterr().err)
    assert time.perf_counter() - begin < 20.0


@pytest.mark.parametrize("key", [b"\x0a\x08location", b"\x0a\x88\x00location"])
@pytest.mark.usefixtures("in_tmp_path")
def test_weights_in_another_file_are_not_read(policy_file: Path, capsys: pytest.CaptureFixture[str], key: bytes):
    """Beside the policy or where the command runs; the length of a key may be written in more than one way."""
    proto = onnx.load(policy_file)
    onnx.save(proto, "outside.onnx", save_as_external_data=True, location="weights.bin", size_threshold=0)
    assert Path("weights.bin").exists()
    data = Path("outside.onnx").read_bytes()
    if key != b"\x0a\x08location":
        tensor = onnx.TensorProto(name="w", data_type=1, dims=[1], data_location=1).SerializeToString()
        entry = key + b"\x12\x0bweights.bin"
        tensor += b"\x6a" + bytes([len(entry)]) + entry
        graph = b"\x2a" + bytes([len(tensor)]) + tensor
        data = (policy_file).read_bytes() + b"\x3a" + bytes([len(graph)]) + graph
        assert onnx.ModelProto.FromString(data).graph.initializer[-1].external_data[0].key == "location"
    Path("outside.onnx").write_bytes(data)
    assert deploy.main(["--policy", "outside.onnx"]) == 2
    assert "'outside.onnx' cannot be read as ONNX: its weights lie in another file" in capsys.readouterr().err
