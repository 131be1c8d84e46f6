import pytest

from tests.evaluation.accelerate.small import GRID, ask
from tests.fixtures.diffusion import demos, make_image_demos, make_network  # noqa: F401
from tests.policies.diffusion.conftest import make_image_policy  # noqa: F401
from torchrl_sparse import DiffusionPolicy, Normalizer, Sampler
from torchrl_sparse.evaluation.accelerate import run


@pytest.fixture
def policy(make_network, demos):  # noqa: F811
    """Of a file, so that fp16 changes its weights no more, and with a chain of eight steps."""
    normalizer = Normalizer.fit(demos.data["observation", "state"], demos.data["action"], poses=True)
    network = make_network().half().float()
    return DiffusionPolicy(network, normalizer, sampler=Sampler("ddpm", 8), engine="reference")


@pytest.fixture
def go(policy, demos, tmp_path):  # noqa: F811
    """Run the acceleration of the small policy, in one folder."""

    def accelerate(grid=GRID, made_for=None, pruner=None, **changes):
        made_for = made_for or {"demos": "walks.h5"}
        return run.accelerate(
            policy,
            demos,
            tmp_path,
            ask(**changes),
            made_for=made_for,
            grid=grid,
            pruner=pruner,
            make_env=None,
        )

    return accelerate
