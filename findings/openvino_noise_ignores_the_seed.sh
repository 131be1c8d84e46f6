#!/usr/bin/env bash
# A sampler that was converted to OpenVINO begins the same stream of noise whenever it is compiled.
#
# Versions: openvino 2026.4.1, torch 2.13.0.
# Guess: noise inside a converted model follows `torch.manual_seed`, or differs between two compiled models.
# What happens: neither. The seed of a graph's random operators is part of the graph: two compilations give the same first numbers, the
#   same second ones, and so on, whatever `torch.manual_seed` said before conversion or before a run.
# Hurts: stochastic samplers: every restart of a robot's program plays the same noise, and "ten seeds" of an evaluation are one seed.
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

def compiled(seed):
    torch.manual_seed(seed)
    model = openvino.convert_model(Noise(), example_input=torch.zeros(3))
    ready = openvino.Core().compile_model(model, "CPU")
    torch.manual_seed(seed)
    return [ready(np.zeros(3, "f4"))[0] for _ in range(2)]

one, two = compiled(1), compiled(2)
print("seed 1:", one)
print("seed 2:", two)
assert np.array_equal(one, two) and not np.array_equal(one[0], one[1])
EOF
