"""Convert a published checkpoint to the files that `DiffusionPolicy.from_pretrained` reads.

    python -m torchrl_sparse.policies.diffusion.convert "epoch=0650-test_mean_score=1.000.ckpt" policies/lift

The weights are written in full precision; ``--half`` writes fp16, half the size.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m torchrl_sparse.policies.diffusion.convert",
        description="Converts a published Diffusion Policy checkpoint. Nothing in it is executed.",
    )
    parser.add_argument("checkpoint", help="a .ckpt file of the published code")
    parser.add_argument("out", help="folder for config.json and model.safetensors")
    parser.add_argument("--half", action="store_true", help="write fp16 weights")
    parser.add_argument("--ignore", nargs="+", default=[], metavar="ENTRY", help="entries of no effect here")
    options = parser.parse_args(arguments)
    try:
        policy = DiffusionPolicy.from_diffusion_policy(options.checkpoint, ignore=options.ignore)
    except (OSError, ValueError) as error:
        print(f"convert: {error}", file=sys.stderr)
        return 1
    policy.save_pretrained(options.out, half=options.half)
    described = ", ".join(f"{name} {value}" for name, value in policy.source.items() if value is not None)
    print(f"{options.out}: {described}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
