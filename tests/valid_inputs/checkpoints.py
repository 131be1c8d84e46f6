"""Checkpoints in Diffusion Policy's layout with a changed configuration."""

from tests.storage.published.checkpoints import low_dim_config, write_checkpoint
from torchrl_sparse import DiffusionPolicy


def read(folder, made, *changes, make_config=low_dim_config, **options):
    """The policy of a checkpoint whose payload was changed."""

    def change(payload):
        for one in changes:
            one(payload)

    path = write_checkpoint(folder / "latest.ckpt", made, change=change, make_config=make_config)
    return DiffusionPolicy.from_diffusion_policy(path, **options)


def scheduled(kind, steps, **entries):
    """A change: the scheduler is diffusers' ``kind`` with these entries, in that many steps."""

    def change(payload):
        scheduler = {
            "_target_": f"diffusers.{kind.__name__}",
            "beta_schedule": "squaredcos_cap_v2",
            **entries,
        }
        payload["cfg"].policy.noise_scheduler = {"num_train_timesteps": 100} | scheduler
        payload["cfg"].policy.num_inference_steps = steps

    return change
