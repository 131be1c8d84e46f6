"""Policies that the real LeRobot writes now answer here as they do there; `make test-peers` builds its environment."""

import os
import subprocess
from pathlib import Path

import pytest

from tests.lerobot_answers import MOST, error
from tests.peers.lerobot.conftest import LEROBOT
from torchrl_sparse import DiffusionPolicy

pytestmark = [
    pytest.mark.skipif(not LEROBOT.is_file(), reason="LeRobot's environment is not built: make test-peers"),
    pytest.mark.filterwarnings("ignore:num_inference_steps"),
]
NAMES = ["diffusion", "flow", "flow_both", "mean_std", "noclip", "quantiles", "sample_ddim", "stateless"]


@pytest.fixture(scope="module")
def policies(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clip_policies")
    script = Path(__file__).with_name("write_policies.py")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run(
        [LEROBOT, script, folder], check=True, env=environment | {"HF_HUB_OFFLINE": "1"}, capture_output=True
    )
    return folder


@pytest.mark.parametrize("engine", ["reference", "torch"])
@pytest.mark.parametrize("name", NAMES)
def test_each_variant_answers_as_lerobot_does(policies, name, engine):
    policy = DiffusionPolicy.from_lerobot(policies / name, engine=engine)
    assert error(policies / name, policy) <= MOST


def test_all_variants_are_compared(policies):
    assert sorted(path.name for path in policies.iterdir() if path.name != "clip_made") == NAMES
