#!/usr/bin/env bash
# PyTorch's own FLOP counter finds no FLOPs in a Transformer that is used as robots use it.
#
# Versions: torch 2.13.0 (`torch.utils.flop_counter`).
# Guess: a Transformer encoder layer has the same FLOPs in training and in evaluation.
# What happens: in `eval()` under `no_grad`, layer and attention run as one fused operator that the counter has no formula
#   for: 0 FLOPs. In training it finds 2,017,280, which is right; in evaluation with gradients 1,966,080, since attention's own
#   products are then a fused operator too. A decoder layer counts 2,723,840, 2,621,440 and 1,966,080: less each time, and
#   still a plausible number.
# Hurts: every table "FLOPs of the policy at inference", and ratios of pruned to dense that are taken this way.
# Live with it: count in training mode (with dropout, as by default), or by hand.
# torchrl_sparse: right; it counts by formulas of its own (`blocks/engine/costs.py`), never by this counter.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.13.0 numpy==2.4.6
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode
torch.manual_seed(0)
x = torch.randn(2, 10, 64)
options = dict(d_model=64, nhead=4, dim_feedforward=256, batch_first=True)
cases = {
    "encoder layer": (nn.TransformerEncoderLayer(**options), lambda m: m(x)),
    "attention": (nn.MultiheadAttention(64, 4, batch_first=True), lambda m: m(x, x, x, need_weights=False)),
    "decoder layer": (nn.TransformerDecoderLayer(**options), lambda m: m(x, x)),
}

def flops(module, call, training, gradients):
    module.train(training)
    with torch.set_grad_enabled(gradients), FlopCounterMode(display=False) as counter:
        call(module)
    return counter.get_total_flops()

found = {}
for name, (module, call) in cases.items():
    found[name] = [flops(module, call, *mode) for mode in ((True, True), (False, True), (False, False))]
    print(f"{name:14} training {found[name][0]:>9}, eval {found[name][1]:>9}, eval without gradients {found[name][2]:>9}")
assert found["encoder layer"] == [2017280, 1966080, 0]
assert found["attention"][2] == 0
assert found["decoder layer"] == [2723840, 2621440, 1966080]
by_hand = 2 * 2 * (4 * 10 * 64 * 64 + 2 * 10 * 10 * 64 + 2 * 10 * 64 * 256)  # rows, projections, attention, feed-forward
print("encoder layer by hand:", by_hand)
assert by_hand == found["encoder layer"][0]
EOF
