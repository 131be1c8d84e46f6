"""Play the same episode with one policy, dense and under a training-free cache schedule, and print the share of FLOPs left.

python recipes/examples/accelerate_one_policy.py
"""

from torchrl_sparse import BAC, ChunkExecutor, DiffusionPolicy, make_env

policy = DiffusionPolicy.from_pretrained("assets/lift")
flops = {}
for name, plan in {"dense": None, "bac": BAC.from_pretrained("assets/lift/bac.json")}.items():
    policy.plan = plan
    episode = make_env("Lift", seeds=[100000], horizon=60).rollout(60, ChunkExecutor(policy))
    flops[name] = episode["cost", "flops"].max().item()
    print(f"{name}: {len(episode)} steps, success {episode['next', 'success'].any().item()}")
print(f"bac computes {flops['bac'] / flops['dense']:.2f} of the FLOPs")
