"""Measure success against latency in a world that moves on.

The environment keeps moving while the policy computes.

    python recipes/realtime.py task=lift_moving policy=runs/lift_moving/policy methods=[dense,ddim10,bac] episodes=100

Kill it and run it again to go on: finished episodes are read from OUT/episodes. Latency 0 is the ordinary evaluation.
``NAME_ahead`` shows the policy the state in which its answer will begin; ``demos`` is what the model of the state is fitted to.
"""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.control.roll_forward import StateModel
from torchrl_sparse.data.for_policy import policy_demos
from torchrl_sparse.envs.contract import policy_contract
from torchrl_sparse.envs.for_policy import diffusion_env
from torchrl_sparse.envs.tasks import RobosuiteTask, find_robosuite_task
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.benchmarks.benchmark import BenchmarkOptions
from torchrl_sparse.evaluation.benchmarks.delayed import RealtimeBenchmark
from torchrl_sparse.evaluation.benchmarks.diffusion import make_methods
from torchrl_sparse.evaluation.results.realtime import format_realtime
from torchrl_sparse.methods.diffusion import check_method
from torchrl_sparse.methods.spec import MethodSpec
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.diffusion.calibration import lazy_calibration
from torchrl_sparse.training.diffusion.published import executed_steps
from torchrl_sparse.training.state_model import fit_state_model


@recipe("realtime")
def main(config: DictConfig) -> None:
    task, planners = find_robosuite_task(config.task), Path(config.planners)
    for name in config.methods:
        check_method(name, planners)
    policy = DiffusionPolicy.from_pretrained(config.policy, engine=config.engine).to(config.device)
    seen = policy_contract(task.name, policy).state_keys
    if seen != task.state_keys:  # from which the pose to hold is read
        raise InputError(
            f"policy: expected one that observes {', '.join(task.state_keys)}, got one of {', '.join(seen)}"
        )
    model = state_model(config, task, policy)
    config.n_action_steps = executed_steps(task.name, policy.source, config.n_action_steps)
    make_env = diffusion_env(task.name, policy, config.horizon)
    calibration = lazy_calibration(policy, make_env, config.calibration_samples)
    methods = make_methods(
        config.methods, policy, num_updates=config.num_updates, planners=planners, calibration=calibration
    )
    options = BenchmarkOptions.of(config)
    results = RealtimeBenchmark(options, task, methods, make_env, config.latencies, model).run()
    print(f"\n{format_realtime(results)}\n\nfiles are in {options.out}")


def state_model(config: DictConfig, task: RobosuiteTask, policy: DiffusionPolicy) -> StateModel | None:
    """Fit the state model that methods named ``_ahead`` roll the state forward with; None if there are none."""
    if not any(MethodSpec.parse(name).ahead for name in config.methods):
        return None
    if config.demos is None:
        raise InputError("demos: expected demonstrations to fit the _ahead methods' model to, got null")
    demos, steps = policy_demos(config.demos, task.name, policy), 3
    model, error = fit_state_model(demos, steps)
    print(
        f"{config.demos}: {steps} steps ahead the model of the state errs by {error:.2f} of what no model does"
    )
    return model


if __name__ == "__main__":
    main()
