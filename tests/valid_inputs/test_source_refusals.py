"""What cannot be translated into the contract of a policy is refused by one line that names both sides."""

import json

import h5py
import torch
from tensordict import TensorDict

from tests.data.published_demos import env_args_14
from tests.refusals import refused
from tests.training.vla.rendered import write_demos
from tests.valid_inputs.test_source import (  # noqa: F401  a fixture
    OLD_KEYS,
    files,
    old_policy,
    own_policy,
    write,
)
from torchrl_sparse import keys
from torchrl_sparse.data.for_policy import contract_demos, instructed_demos, policy_demos
from torchrl_sparse.data.robomimic import Demonstrations, join_demos, read_demos
from torchrl_sparse.envs.contract import continued_source, task_contract
from torchrl_sparse.envs.instructed import continued_vla_source
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.networks.vla import VLAConfig, VLANetwork
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.storage.vla import VLASource
from torchrl_sparse.training.demonstrations import TrainConfig
from torchrl_sparse.training.diffusion.targets import make_targets
from torchrl_sparse.training.diffusion.trainer import PolicyTrainer


def test_a_file_that_names_no_robosuite_is_shown_to_nobody(tmp_path):
    """Of a file without env_args nobody knows which robosuite recorded the objects."""
    path = write(tmp_path / "silent.h5", "Lift", "1.5")
    policies = own_policy("Lift", path), old_policy("Lift", path)
    with h5py.File(path, "a") as file:
        del file["data"].attrs["env_args"]
    for policy in policies:
        with refused("silent.h5"):
            policy_demos(path, "lift", policy)


def test_the_version_counts_more_than_the_form_of_the_controller(files, tmp_path):  # noqa: F811
    """robosuite 1.5 still reads controllers in the old form, and files are written so."""
    path = write(tmp_path / "mixed.h5", "Lift", "1.5", {"env_version": "1.5.1"})
    with h5py.File(path, "a") as file:
        options = {"input_type": "absolute", "input_ref_frame": "world"}
        file["data"].attrs["env_args"] = json.dumps(
            env_args_14(find_task("Lift"), **options) | {"env_version": "1.5.1"}
        )
    shown = [
        contract_demos(file, task_contract("Lift")).data[keys.STATE] for file in (path, files["Lift", "1.5"])
    ]
    assert torch.equal(*shown)


def test_an_unknown_version_is_named(tmp_path):
    path = write(tmp_path / "newest.h5", "Lift", "1.5", {"env_version": "master"})
    with refused("newest.h5, env_args.env_version"):
        contract_demos(path, task_contract("Lift"))


def test_a_variant_that_only_robosuite_15_knows_is_refused_to_a_policy_of_14(files, tmp_path):  # noqa: F811
    """Lift's moving cube is of this library, so that nobody observed it under 1.4."""
    old = old_policy("Lift", files["Lift", "1.5"])
    old.source = continued_source("lift_moving", old)
    path = write(tmp_path / "moving.h5", "LiftMoving", "1.5")
    entry = "5, wanted as of 1.4: convention"
    with refused(entry):
        policy_demos(path, "lift_moving", old)


def test_demonstrations_that_were_read_for_another_policy_are_refused(files):  # noqa: F811
    """`read_demos` with the right names and the wrong convention or order passes every check of sizes."""
    policy, path = old_policy("Lift", files["Lift", "1.5"]), files["Lift", "1.4"]
    present = read_demos(path, OLD_KEYS, task="Lift")
    with refused("demos"):
        make_targets(policy, present, share=0.5, n_action_steps=3)
    swapped = read_demos(path, find_task("Lift").state_keys, convention="1.4")
    with refused("demos"):
        PolicyTrainer(policy, swapped, TrainConfig(max_steps=1, n_action_steps=3))
    with refused("demos"):
        join_demos([present, swapped])


def test_other_cameras_than_the_policys_are_refused_as_in_the_environment(tmp_path):
    """`cameras.image=frontview_image` has the size of any other camera."""
    policy = VLAPolicy(VLANetwork(VLAConfig.tiny(state_dim=9, action_dim=10)))
    policy.source = VLASource("LiftNamed", {"image": "agentview_image"})
    path, others = write_demos(tmp_path / "images.h5"), {"image": "robot0_eye_in_hand_image"}
    entry = "cameras.image"
    with refused(entry):
        instructed_demos(path, "lift_named", others, policy)
    with refused(entry):
        continued_vla_source("lift_named", policy, others)
    with refused("policy"):
        instructed_demos(path, "lift", {"image": "agentview_image"}, policy)
    continued = continued_vla_source("lift", policy, {"image": "agentview_image"})
    assert continued == VLASource("Lift", {"image": "agentview_image"})


def test_a_part_of_the_demonstrations_keeps_what_a_policy_drove():
    """Rows before the expert took over are history and no present (`torchrl_sparse.data.dagger`)."""
    state = torch.arange(12.0)[:, None]
    data = TensorDict({keys.STATE: state, keys.ACTION: state}, [12])
    demos = Demonstrations(data, torch.tensor([0, 6, 12]), torch.tensor([0, 4]))
    part = demos.between(1, 2)
    assert torch.equal(part.window_rows(2, 1, 1) + 6, demos.window_rows(2, 1, 1, [1]))
