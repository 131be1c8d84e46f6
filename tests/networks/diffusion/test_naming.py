"""Samplers by name and by configuration, and arguments that are none."""

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse.networks.diffusion.sampler import Sampler

SHAPE = (2, 10, 10)

NAMES = {
    "ddpm10": Sampler("ddpm", 10),
    "ddpm10_trailing": Sampler("ddpm", 10, spacing="trailing"),
    "ddpm2_logsnr": Sampler("ddpm", 2, spacing="logsnr"),
    "ddpm_82_14": Sampler("ddpm", timesteps=[82, 14]),
    "ddim100": Sampler("ddim", 100),
    "ddim10_eta0.5": Sampler("ddim", 10, eta=0.5),
    "ddim10_linspace_eta1": Sampler("ddim", 10, spacing="linspace", eta=1),
    "ddim_82_14_eta0.00001": Sampler("ddim", timesteps=[82, 14], eta=1e-5),
    "dpmpp2m10": Sampler("dpmpp2m", 10),
    "sde2m10_trailing": Sampler("sde2m", 10, spacing="trailing"),
    "unipc_90_40_2": Sampler("unipc", timesteps=[90, 40, 2]),
}


@pytest.mark.parametrize("name", NAMES)
def test_names_and_configs_rebuild_the_sampler(name):
    sampler = NAMES[name]
    by_name = Sampler.from_name(sampler.name, sampler.num_inference_steps)
    for again in (Sampler.from_name(name), Sampler(**sampler.config), by_name):
        assert repr(again) == repr(sampler)
        assert torch.equal(again.timesteps, sampler.timesteps)
        assert torch.equal(again.coefficients.table(), sampler.coefficients.table())


def test_names_and_configs_of_old_files_are_unchanged():
    assert Sampler().name == Sampler("ddpm", 10).name == "ddpm"
    assert Sampler("ddim", timesteps=[90, 50, 10]).name == "ddim_90_50_10"
    assert Sampler("ddim", 7, 50).config == {
        "kind": "ddim",
        "num_inference_steps": 7,
        "num_train_timesteps": 50,
    }
    assert Sampler("ddim", timesteps=[9, 4]).config["timesteps"] == [9, 4]


@pytest.mark.parametrize(
    ("arguments", "entry"),
    [
        ({"kind": "euler"}, "kind"),
        ({"spacing": "even"}, "spacing"),
        ({"eta": 0.5}, "eta"),
        ({"kind": "ddim", "eta": 1.5}, "eta"),
        ({"kind": "ddim", "eta": float("nan")}, "eta"),
        ({"kind": "ddim", "eta": "0.5"}, "eta"),
        (
            {"kind": "ddim", "num_inference_steps": 101},
            "num_inference_steps",
        ),
        ({"num_inference_steps": 12, "spacing": "logsnr"}, "num_inference_steps"),
        ({"kind": "unipc"}, "num_inference_steps"),
        ({"timesteps": [9, 5], "spacing": "trailing"}, "spacing"),
        ({"timesteps": []}, "num_inference_steps"),
    ],
)
def test_bad_arguments_are_named(arguments, entry):
    with refused(entry):
        Sampler(**arguments)


@pytest.mark.parametrize("kind", ["ddpm", "ddim", "sde2m"])
@pytest.mark.parametrize(
    ("steps", "timesteps"),
    [(2, [5, 5]), (2, [1, 9]), (1, [100]), (1, [-1]), (1, [float("inf")]), (2, ["9", "5"]), (3, [9, 5])],
)
def test_timesteps_that_do_not_fall_are_refused(kind, steps, timesteps):
    with refused("timesteps"):
        Sampler(kind, steps, timesteps=timesteps)


@pytest.mark.parametrize(
    "name",
    ["ddim_", "ddim_-3", "euler", "ddim_0.5", "ddim_9_x", "ddpm10_82_14", "ddim0", "ddim_eta", "ddim_eta0.5_trailing",
     "ddim_123456", None],
)  # fmt: skip
def test_other_names_are_refused(name):
    with refused("sampler"):
        Sampler.from_name(name, 2)


def test_a_name_and_a_number_of_steps_must_agree():
    with refused("num_inference_steps"):
        Sampler.from_name("ddpm10", 5)
    with refused("timesteps"):
        Sampler.from_name("ddim_9_5", 3)


def test_a_sampler_cannot_be_changed():
    sampler = Sampler("ddpm", 10)
    with pytest.raises(AttributeError, match="timesteps: expected a sampler to stay as it was made"):
        sampler.timesteps = torch.tensor([9])
    with pytest.raises(AttributeError, match="coefficients: expected a sampler to stay"):
        del sampler.coefficients


def test_steps_say_what_they_need():
    sampler, sample = Sampler(), torch.zeros(SHAPE)
    with refused("noise_k"):
        sampler.step(sample, 3, sample)
    with refused("k must be in 0..99", IndexError):
        sampler.step(sample, 100, sample)
    with refused("cleans"):
        Sampler("unipc", 5).step(sample, 3, sample, cleans=(sample,))
