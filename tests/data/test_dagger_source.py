"""DAgger with policies that observe the world in another way."""

from dataclasses import replace

import numpy as np
import torch

from tests.data.test_dagger import driving  # noqa: F401  a fixture
from tests.policies.diffusion.conftest import make_image_policy  # noqa: F401  a fixture
from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy
from torchrl_sparse.data.dagger import load_driver
from torchrl_sparse.data.demonstrate import demonstrate
from torchrl_sparse.envs.robosuite import RobosuiteEnv
from torchrl_sparse.envs.tasks import find_task


def test_a_policy_of_another_convention_drives_as_it_would_in_its_own_environment(driving, monkeypatch):  # noqa: F811
    """The same function of the same world, with the vector to the cube as robosuite 1.4 observed it."""
    read = DiffusionPolicy.from_pretrained

    def imported(path):
        policy = read(path, engine="reference")
        with torch.no_grad():
            policy.network.cond_obs_emb.weight[:, 7:10] *= -1
        policy.normalizer.state_offset[7:10] *= -1
        policy.source = {"weights": "ema_model"}
        return policy

    task, env = find_task("Lift"), RobosuiteEnv("Lift")
    own = demonstrate(task, env, 300, driver=load_driver("Lift", driving))
    monkeypatch.setattr(DiffusionPolicy, "from_pretrained", imported)
    old = replace(driving, fingerprint=imported("assets/lift").fingerprint)
    episode = demonstrate(task, env, 300, driver=load_driver("Lift", old))
    env.close()
    assert episode.driven == own.driven > 0
    np.testing.assert_allclose(
        episode.executed_actions[: own.driven], own.executed_actions[: own.driven], atol=1e-4
    )
    np.testing.assert_array_equal(episode.observations["object"][0], own.observations["object"][0])


def test_a_policy_with_cameras_cannot_drive(driving, monkeypatch, make_image_policy):  # noqa: F811
    seeing = make_image_policy()
    monkeypatch.setattr(DiffusionPolicy, "from_pretrained", lambda path: seeing)
    with refused("policy"):
        load_driver("Lift", replace(driving, fingerprint=seeing.fingerprint))
