#!/usr/bin/env bash
# A patched block of a Transformer layer runs in training and is skipped in evaluation.
#
# Versions: torch 2.13.0.
# Guess: a cache put into a layer by replacing its `_ff_block` or its `linear1.forward`, or by a hook on one of its modules, is
#   called whenever the layer is.
# What happens: in `eval()` under `no_grad` a `TransformerEncoderLayer` hands its weights to one fused operator. A method
#   replaced on the instance is never called there. Hooks on `self_attn`, `linear1` and the norms do switch the operator off
#   and are called; one on `self_attn.out_proj` never is, in training neither. Trying out one proves nothing about others.
# Hurts: block caches and pruning that are plugged in from outside: tests in training mode pass, and at inference the method
#   silently is the dense model, with dense results and no speed-up.
# Live with it: count the calls, in evaluation; or `torch.backends.mha.set_fastpath_enabled(False)`.
# torchrl_sparse: right; planners of diffusion policies patch no modules: a mask is a key, and its engine owns every block.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.13.0 numpy==2.4.6
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import torch
from torch import nn
x = torch.randn(2, 10, 64)

def calls(plug, training):
    layer = nn.TransformerEncoderLayer(64, 4, 256, batch_first=True).train(training)
    seen = []
    plug(layer, seen)
    with torch.no_grad():
        layer(x)
    return len(seen)

def patch(name, method):
    def plug(layer, seen):
        module = layer.get_submodule(name)
        inner = getattr(module, method)
        setattr(module, method, lambda *a, **k: (seen.append(1), inner(*a, **k))[1])
    return plug

def hook(name):
    return lambda layer, seen: layer.get_submodule(name).register_forward_hook(lambda *a: seen.append(1))

plugs = {
    "_ff_block replaced": patch("", "_ff_block"),
    "linear1.forward replaced": patch("linear1", "forward"),
    "hook on linear1": hook("linear1"),
    "hook on self_attn": hook("self_attn"),
    "hook on self_attn.out_proj": hook("self_attn.out_proj"),
}
found = {name: (calls(plug, True), calls(plug, False)) for name, plug in plugs.items()}
for name, (training, evaluation) in found.items():
    print(f"{name:27} called in training: {training}, in evaluation: {evaluation}")
assert found["_ff_block replaced"] == (1, 0) and found["linear1.forward replaced"] == (1, 0)
assert found["hook on linear1"] == (1, 1) and found["hook on self_attn"] == (1, 1)
assert found["hook on self_attn.out_proj"] == (0, 0)
EOF
