"""Collect data with an accelerated policy in two processes, using TorchRL's own collector.

python recipes/examples/collect.py
"""

from functools import partial

from torchrl.collectors import MultiSyncCollector

from torchrl_sparse import ChunkExecutor, DiffusionPolicy, Sampler, make_env

if __name__ == "__main__":  # processes import this file
    policy = DiffusionPolicy.from_pretrained("assets/lift")
    policy.sampler = Sampler("ddpm", 3, spacing="logsnr")
    makers = [partial(make_env, "Lift", seeds=[100000 + worker]) for worker in range(2)]
    collector = MultiSyncCollector(
        makers,
        ChunkExecutor(policy),
        frames_per_batch=32,
        total_frames=32,
        auto_register_policy_transforms=True,
    )
    for data in collector:
        print(f"{data.numel()} steps, {data['control', 'queried'].sum()} policy calls")
    collector.shutdown()
