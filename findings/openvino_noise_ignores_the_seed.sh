#!/usr/bin/env bash
# A sampler that was converted to OpenVINO plays one stream of noise, whatever seed is set, whenever it is compiled.
#
# Versions: openvino 2026.4.1, torch 2.13.0.
# Guess: noise inside a converted model follows `torch.manual_seed`, or differs between two compilations.
# What happens: neither. A seed that has nothing to do with torch's is written into the graph at conversion: two conversions after the
#   same `torch.manual_seed` differ, while all compilations of one converted or saved model give the same first numbers, the same
#   second ones, and so on.
# Hurts: stochastic samplers: every restart of a robot's program plays the same noise, "ten seeds" of an evaluation are one seed,
#   and exporting the same policy again changes the results.
# Live with it: make noise an input of the graph.
# torchrl_sparse: right; its exports take a seed with each query and draw counter-based noise from it.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.13.0 numpy==2.4.6 openvino==2026.4.1
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import numpy as np, openvino, torch

class Noise(torch.nn.Module):
    def forward(self, x):
        return x + torch.randn(3)

def converted():
    torch.manual_seed(0)
    return openvino.convert_model(Noise(), example_input=torch.zeros(3))

def draws(model, seed):
    torch.manual_seed(seed)
    ready = openvino.Core().compile_model(model, "CPU")
    return [ready(np.zeros(3, "f4"))[0] for _ in range(2)]

model = converted()
openvino.save_model(model, "noise.xml", compress_to_fp16=False)
one, two, saved, again = draws(model, 1), draws(model, 2), draws("noise.xml", 3), draws(converted(), 1)
print("compiled after seed 1:", *one)
print("compiled after seed 2:", *two)
print("saved and read:       ", *saved)
print("converted once more:  ", *again)
assert np.array_equal(one, two) and np.array_equal(one, saved)
assert not np.array_equal(one[0], one[1]) and not np.array_equal(one, again)
EOF
