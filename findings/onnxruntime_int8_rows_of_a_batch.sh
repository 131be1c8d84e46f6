#!/usr/bin/env bash
# In ONNX Runtime's 8 bits a row of a batch changes its neighbours' answers.
#
# Versions: onnxruntime 1.32.0, onnx 1.23.2.
# Guess: what a policy answers to an observation does not depend on which others are asked about in the same batch.
# What happens: dynamic quantisation has one scale for all rows. Beside a row that is twenty times as large, as another
#   environment or an early denoising step may bring, the error of a row's answer grows from 1 % to 8 % of it. All outputs of
#   a matrix share one scale too: one output with large weights costs the other 63 a third of their value, and `per_channel=True`, not
#   the default, is what keeps them to 7 %.
# Hurts: evaluations in parallel environments: success depends on their number, and episodes do not replay alone.
# Live with it: one query at a time, or scales for each row; hold answers in a batch against answers alone.
# torchrl_sparse: right; each token and each output has a scale of its own, and every engine is tested row by row.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 onnx==1.23.2 onnxruntime==1.32.0
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import logging
import numpy as np, onnx, onnxruntime
from onnx import TensorProto as T, helper as h, numpy_helper
from onnxruntime.quantization import QuantType, quantize_dynamic

logging.disable(logging.WARNING)
draw = np.random.default_rng(0)

def quantised(weights, **options):
    shape = ["batch", 64]
    graph = h.make_graph(
        [h.make_node("MatMul", ["x", "w"], ["y"])], "layer",
        [h.make_tensor_value_info("x", T.FLOAT, shape)], [h.make_tensor_value_info("y", T.FLOAT, shape)],
        [numpy_helper.from_array(weights, "w")],
    )
    onnx.save(h.make_model(graph, opset_imports=[h.make_opsetid("", 17)], ir_version=8), "layer.onnx")
    quantize_dynamic("layer.onnx", "int8.onnx", weight_type=QuantType.QInt8, **options)
    session = onnxruntime.InferenceSession("int8.onnx", providers=["CPUExecutionProvider"])
    return lambda x: session.run(None, {"x": x})[0]

def error(found, right):
    return float(np.abs(found - right).max() / np.abs(right).max())

weights = draw.normal(size=(64, 64)).astype("f4") / 8
x, large = draw.normal(size=(1, 64)).astype("f4"), 20 * draw.normal(size=(1, 64)).astype("f4")
ask = quantised(weights)
alone, beside = error(ask(x), x @ weights), error(ask(np.concatenate([x, large]))[:1], x @ weights)
print(f"error of a row alone {alone:.3f}, beside a row twenty times as large {beside:.3f}")
assert alone < 0.02 and beside > 0.05
weights[:, 0] *= 50
one, each = (error(quantised(weights, per_channel=c)(x)[:, 1:], (x @ weights)[:, 1:]) for c in (False, True))
print(f"one output with large weights, error of the others: {one:.3f}, per channel {each:.3f}")
assert one > 0.2 and each < 0.1
EOF
