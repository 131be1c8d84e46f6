"""Going on from a trained policy: what is asked for that it has not is refused by name, not passed over."""

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, Normalizer, TransformerForDiffusion
from torchrl_sparse.networks.diffusion.vision import VisionEncoder
from torchrl_sparse.networks.vla.adapters import add_adapters
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.storage.vla import AdaptedBase
from torchrl_sparse.training.diffusion.begun import begun_policy
from torchrl_sparse.training.vla.untrained import check_sizes

SIZES = {"horizon": 4, "n_obs_steps": 2, "n_layer": 1, "n_head": 2, "n_emb": 8}
OPEN = {"horizon": None, "n_layer": None, "p_drop_attn": None}


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Folders of a policy of states and of one with a camera, the second normalised by one scale."""
    folder = tmp_path_factory.mktemp("policies")
    for name, seeing in (("states", False), ("image", True)):
        options = {"image_size": [48, 48], "crop_size": [42, 42], "width": 16}
        vision = VisionEncoder(["image"], **options) if seeing else None
        width = 3 + (vision.feature_dim if vision else 0)
        network = TransformerForDiffusion(input_dim=2, output_dim=2, cond_dim=width, **SIZES)
        scale = torch.ones(3) if seeing else torch.tensor([1.0, 2.0, 3.0])
        normalizer = Normalizer(scale, torch.zeros(3), torch.ones(2), torch.zeros(2))
        policy = DiffusionPolicy(network, normalizer, vision=vision, engine="reference")
        policy.source = {"task": "mine"}
        policy.save_pretrained(folder / name, half=False)
    return folder


@pytest.mark.parametrize(
    ("name", "asked", "entry"),
    [
        (
            "states",
            {"sizes": {"n_layer": 2}},
            "network.n_layer",
        ),
        ("states", {"sizes": {"horizon": 10}}, "network.horizon"),
        ("states", {"state_mode": "global"}, "state_normalization"),
        ("image", {"state_mode": "range"}, "state_normalization"),
        ("states", {"width": 64}, "vision.width"),
        ("image", {"width": 64}, "vision.width"),
        ("image", {"crop": 0.5}, "vision.crop"),
    ],
)
def test_what_the_policy_has_not_is_refused(saved, name, asked, entry):
    """An option of the command line that is not read is refused unless it says what the policy has."""
    with refused(entry):
        begun_policy(saved / name, **({"sizes": OPEN} | asked))


def test_what_the_policy_has_is_taken(saved):
    own = {"sizes": SIZES, "state_mode": "global", "crop": 0.88, "width": 16}
    begun, read = begun_policy(saved / "image", **own), DiffusionPolicy.from_pretrained(saved / "image")
    assert (begun.fingerprint, begun.source) == (read.fingerprint, read.source)


def test_dropout_is_what_is_asked_for(saved):
    """No weight depends on it, and LeRobot too lets a fine-tuning change it."""
    read = DiffusionPolicy.from_pretrained(saved / "states")
    begun = begun_policy(saved / "states", OPEN | {"p_drop_attn": 0.9})
    assert begun.network.config == read.network.config | {"p_drop_attn": 0.9}
    assert all(torch.equal(begun.state_dict()[name], value) for name, value in read.state_dict().items())
    noise, cond = torch.randn(1, 4, 2), torch.randn(1, 2, 3)
    begun.network.train()
    answers = [begun.network(noise, torch.tensor([3]), cond) for _ in range(2)]
    assert not torch.equal(*answers)
    assert begun_policy(saved / "states", OPEN).network.config["p_drop_attn"] == 0.3


@pytest.mark.parametrize(
    ("asked", "entry"),
    [
        ({"size": "small"}, "size"),
        ({"rank": 16}, "rank"),
        (
            {"changes": {"chunk_size": 8}},
            "network",
        ),
        ({"changes": {"llm": {"layers": 9}}}, "network"),
    ],
)
def test_sizes_that_a_vla_has_not_are_refused(asked, entry):
    config = VLAConfig.tiny()
    policy = VLAPolicy(add_adapters(VLANetwork(config), 2))
    policy.base = AdaptedBase("0" * 64, 2)
    nothing = {"size": None, "rank": None, "changes": {}}
    own = {"rank": 2, "changes": {"chunk_size": config.chunk_size, "llm": {"layers": config.llm.layers}}}
    check_sizes(policy, "mine", **nothing | own)
    with refused(entry):
        check_sizes(policy, "mine", **nothing | asked)
