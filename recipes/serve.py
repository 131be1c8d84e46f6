"""Serve a policy to robots in other processes.

It speaks openpi's websocket protocol: the client is the package `openpi-client`.

    torchrl-sparse serve policy=assets/lift method=ddpm5_logsnr port=8000        # to this machine alone
    torchrl-sparse serve policy=assets/lift answers=chunk host=0.0.0.0           # chunks, to whoever reaches this machine

    policy = websocket_client_policy.WebsocketClientPolicy("127.0.0.1", 8000)    # of openpi_client
    action = policy.infer({"observation/state": state})["actions"][0]

A connection is a robot with a history, a chunk and an episode of its own; a request with "episode/reset" begins the next
episode. http://HOST:PORT/healthz and /status answer plain requests. Ctrl-C or SIGTERM ends it. Extra `serve`.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.envs.contract import Contract, named_task, policy_contract
from torchrl_sparse.errors import InputError
from torchrl_sparse.methods.diffusion import check_method, make_method
from torchrl_sparse.methods.executor import make_executor
from torchrl_sparse.methods.spec import MethodSpec
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.serving.server import PolicyServer
from torchrl_sparse.training.diffusion.published import executed_steps

tell = partial(print, flush=True)  # also where nobody reads along


@recipe("serve", out=None)
def main(config: DictConfig) -> None:
    torch.set_num_threads(config.threads or torch.get_num_threads())
    policy = DiffusionPolicy.from_pretrained(config.policy, engine=config.engine).to(config.device)
    contract = find_contract(config.task, policy)
    server = PolicyServer(
        make_actor(config, policy, contract),
        contract,
        answers=config.answers,
        seed=config.seed,
        max_clients=config.max_clients,
        max_message_bytes=config.max_message_bytes,
        threads=config.threads,
        facts={"policy": str(config.policy), "method": config.method},
        log=tell,
    )

    def ready(port: int) -> None:
        tell(f"serving {config.policy} at ws://{config.host}:{port}, {server.metadata['engine']}")

    server.run(config.host, config.port, ready=ready, report_every=config.report_every)
    tell(f"served {server.status()['requests']} requests")


def find_contract(task: str | None, policy: DiffusionPolicy) -> Contract | None:
    """Return what the policy observes of a task, by default of the one that its ``source`` names; None if none is known."""
    trained = policy.source.get("task")
    name = task or (trained and named_task(trained))
    return policy_contract(name, policy) if name else None


def make_actor(config: DictConfig, policy: DiffusionPolicy, contract: Contract | None) -> ChunkExecutor:
    """Return the executor of the method, or of the policy as it was saved."""
    task, chosen = contract and contract.task, config.n_action_steps
    if config.answers == "chunk":
        steps = 1  # every request is a policy call
        if chosen is not None or (config.method and MethodSpec.parse(config.method).every):
            raise InputError(
                "n_action_steps: expected null with answers=chunk, as the client plays the chunk"
            )
    elif task:
        steps = executed_steps(task, policy.source, chosen)
    else:
        steps = min(chosen or policy.source.get("n_action_steps") or 8, policy.chunk_shape[0])
    if config.method is None:
        return make_executor("dense", policy.freeze(), steps)
    planners = Path(config.planners)
    check_method(config.method, planners)
    options: dict[str, Any] = {"num_updates": config.num_updates, "planners": planners}
    made = make_method(config.method, policy, calibration=no_calibration, **options)
    return make_executor(config.method, made.freeze(), steps)


def no_calibration() -> Any:
    raise InputError(
        "method: expected a schedule of num_updates updates in planners, got none; see calibrate_bac"
    )


if __name__ == "__main__":
    main()
