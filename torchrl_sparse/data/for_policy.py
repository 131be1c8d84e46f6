"""Demonstrations read as a given policy observes them, for every training and calibration.

What a policy observes is its contract (`torchrl_sparse.envs.contract`): names and order of the state, the version of robosuite
whose meaning it has, and the cameras. What a file recorded in another way is translated, or refused. A vision-language-action
policy's is its task and its cameras (`torchrl_sparse.envs.instructed`); of the state it reads the arm's part alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_sparse.data.robomimic import Demonstrations, read_demos
from torchrl_sparse.envs.contract import Contract, policy_contract
from torchrl_sparse.envs.instructed import check_instructed
from torchrl_sparse.envs.tasks import find_robosuite_task, find_task
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.policies.vla.policy import VLAPolicy

__all__ = ["contract_demos", "instructed_demos", "policy_demos"]


def policy_demos(
    paths: str | Path | Sequence[str | Path], task: str, policy: DiffusionPolicy, **options: Any
) -> Demonstrations:
    """Read a task's demonstrations with the state and cameras that ``policy`` was trained on.

    Args:
        paths: of an HDF5 file or of several, see `read_demos`.
        task: a name or alias.
        policy: see `policy_contract`.
        options: as of `contract_demos`.

    Raises:
        FileNotFoundError: if there is no file.
        InputError: as `read_demos` and `policy_contract`; so if the file has no images of the policy's cameras.

    Examples:
        >>> policy = DiffusionPolicy.from_pretrained("assets/lift")
        >>> policy_demos("data/lift.h5", "lift", policy).data["observation", "state"].shape[1]  # doctest: +SKIP
        19
    """
    return contract_demos(paths, policy_contract(task, policy), **options)


def contract_demos(
    paths: str | Path | Sequence[str | Path], contract: Contract, **options: Any
) -> Demonstrations:
    """Read demonstrations under an observation contract, such as that of a policy yet to be trained.

    Args:
        paths: see `read_demos`.
        contract: of a known task.
        options: ``filter_key`` and ``image_folder`` of `read_demos`.

    Raises:
        FileNotFoundError, InputError: as `read_demos`.
    """
    task = find_task(str(contract.task))
    return read_demos(
        paths,
        contract.state_keys,
        cameras=contract.cameras,
        poses=task.acts_in_poses,
        task=task.name,
        convention=contract.convention,
        **options,
    )


def instructed_demos(
    paths: str | Path | Sequence[str | Path],
    task: str,
    cameras: Mapping[str, str],
    policy: VLAPolicy | None = None,
    **options: Any,
) -> Demonstrations:
    """Read a task's demonstrations with images for a vision-language-action policy.

    Args:
        paths: see `read_demos`.
        task: name or alias of a task of robosuite.
        cameras: name of an image here -> its name in the file.
        policy: that is shown them; None for one that is yet to be trained.
        options: as of `contract_demos`.

    Raises:
        FileNotFoundError, InputError: as `read_demos` and, with a policy, `check_instructed`.
    """
    if policy is not None:
        check_instructed(task, policy, cameras)
    found = find_robosuite_task(task)
    return contract_demos(paths, Contract(found.name, found.proprioception_keys, cameras=cameras), **options)
