#!/usr/bin/env bash
# The seed of noise inside an ONNX graph counts when the session is made, not when it runs.
#
# Versions: onnxruntime 1.32.0, onnx 1.23.2.
# Guess: `onnxruntime.set_seed(1)` before each run repeats the run, as torch.manual_seed does.
# What happens: it is read once, by each random operator, when the session is made. Two runs after the same seed differ; two
#   sessions made after the same seed agree, run by run. And a `seed` attribute in the graph is worse: two operators with
#   the same one draw the same numbers in every run, so two denoising steps share their noise.
# Hurts: exported stochastic samplers: paired episodes on "the same noise" are not paired, replays do not replay.
# Live with it: make noise an input of the graph.
# torchrl_sparse: right; its exports take a seed with each query and draw counter-based noise from it.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 onnx==1.23.2 onnxruntime==1.32.0
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import numpy as np, onnx, onnxruntime
from onnx import TensorProto as T, helper as h

def session(**attributes):
    nodes = [h.make_node("RandomNormal", [], [name], shape=[3], **attributes) for name in ("a", "b")]
    graph = h.make_graph(nodes, "noise", [], [h.make_tensor_value_info(n, T.FLOAT, [3]) for n in ("a", "b")])
    onnx.save(h.make_model(graph, opset_imports=[h.make_opsetid("", 17)], ir_version=8), "noise.onnx")
    return onnxruntime.InferenceSession("noise.onnx", providers=["CPUExecutionProvider"])

def seeded(make):
    onnxruntime.set_seed(1)
    return make()

one = session()
first, second = (seeded(lambda: one.run(None, {})) for _ in range(2))
print("seed before each run:    ", first[0], second[0])
assert not np.array_equal(first, second)
a, b = seeded(session), seeded(session)
first, second = a.run(None, {}), b.run(None, {})
print("seed before each session:", first[0], second[0])
assert np.array_equal(first, second)
left, right = session(seed=7.0).run(None, {})
print("seed attribute, two operators:", left, right)
assert np.array_equal(left, right)
EOF
