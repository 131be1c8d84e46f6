"""Write your own method in one class that decides what to skip; the library's engine checks, counts and runs it.

python recipes/examples/your_planner.py
"""

import torch

from torchrl_sparse import ChunkExecutor, DiffusionPolicy, StaticPlanner, make_env


class SkipOddSteps(StaticPlanner):
    """Planner that skips every block at the odd denoising steps."""

    def mask(self, spec):
        step = torch.arange(spec.num_inference_steps)
        return (step % 2 == 1)[:, None].expand(-1, spec.num_blocks)  # bool [K, 3L], True = pruned


policy = DiffusionPolicy.from_pretrained("assets/lift")
policy.plan = SkipOddSteps()
data = make_env("Lift", seeds=[100000]).rollout(8, ChunkExecutor(policy))
print(f"{data['diffusion', 'prune_mask'][0].float().mean():.2f} of the blocks are skipped")
