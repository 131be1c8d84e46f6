"""Find out where the time of one policy call goes.

    python recipes/profile_policy.py policy=assets/lift                                  # parts, threads and tail of a call
    python recipes/profile_policy.py policy=assets/lift tables=[engines] batches=[1,16]  # every engine against PyTorch eager
    python recipes/profile_policy.py queries=100000 hz=50 busy=1 library=build/tsp/libtsp.so   # what a control loop can rely on
    python recipes/profile_policy.py policy=assets/vla                  # parts of a VLA's call, and what pruning saves
    python recipes/profile_policy.py shape=openvla_oft device=cuda dtype=bfloat16        # untrained, of the published 7B shape
    python recipes/profile_policy.py world=true                         # steps and resets of robosuite's tasks, no policy

It leaves OUT/query.json, OUT/engine.json, OUT/vla_latency.json or OUT/world.json, and charts. Of the tail every call counts:
Ctrl-C ends it with those that there are.
"""

from __future__ import annotations

from pathlib import Path

import torch
from omegaconf import DictConfig

from torchrl_sparse.blocks.bac import BAC
from torchrl_sparse.cli.recipe import recipe, refuse_unread
from torchrl_sparse.cli.vla import is_vla, load_vla
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.benchmarks.engine_times import profile_engines
from torchrl_sparse.evaluation.benchmarks.policy_call import measure_call
from torchrl_sparse.evaluation.benchmarks.vla_latency import measure_vla, token_pruners
from torchrl_sparse.evaluation.benchmarks.world import measure_world
from torchrl_sparse.evaluation.figures.latency import plot_thread_scaling, plot_vla_times
from torchrl_sparse.evaluation.latency import engine_cases, vla_cases
from torchrl_sparse.evaluation.latency.measure import describe_machine
from torchrl_sparse.evaluation.latency.stages import untrained_policy
from torchrl_sparse.evaluation.results.query_report import format_query_profile
from torchrl_sparse.evaluation.results.vla_report import format_vla_table
from torchrl_sparse.evaluation.results.world_report import format_world_profile
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.runtime.threads import num_threads
from torchrl_sparse.storage.json import write_json

_CALL = ("sampler", "engine", "thread_counts", "queries", "hz", "library", "busy")
_ENGINES = ("batches", "compile", "instruction_sets")
_FILES = ("base", "heads", "published", "task")
_VLA = (*_FILES, "instruction", "dtype", "alphas", "shares", "equal_to")


@recipe("profile_policy")
def main(config: DictConfig) -> None:
    shapes = (*engine_cases.SHAPES, *vla_cases.SHAPES)
    if config.shape is not None:
        refuse_unread(config, ("policy", *_FILES), __file__, "beside a shape")
        if config.shape not in shapes:
            raise InputError(f"shape: expected one of {', '.join(shapes)}, got {config.shape!r}")
    if config.world:
        profile_world(config)
    elif config.shape in vla_cases.SHAPES or (config.shape is None and is_vla(config.policy)):
        profile_vla(config)
    else:
        profile_diffusion(config)
    print(f"\nfiles are in {config.out}")


def profile_world(config: DictConfig) -> None:
    read = ("threads", "repeats", "warmup")
    refuse_unread(config, [*{*config} - {*read, "out", "world"}], __file__, "of the world")
    found = measure_world(**{name: config[name] for name in read})
    write_json(Path(config.out, "world.json"), found)
    print(f"\n{format_world_profile(found)}")


def profile_diffusion(config: DictConfig) -> None:
    refuse_unread(config, _VLA, __file__, "of a diffusion policy")
    for table, options in (("call", _CALL), ("engines", _ENGINES)):
        if table not in config.tables:
            refuse_unread(config, options, __file__, f"without the table {table}")
    if "call" in config.tables:
        refuse_unread(config, ("device",), __file__, "with the table call")
    if config.shape is None:
        policy = DiffusionPolicy.from_pretrained(config.policy, engine=config.engine)
    else:
        policy = untrained_policy(config.shape, engine=config.engine)
    if config.sampler is not None:
        policy.sampler = policy.sampler.variant_named(config.sampler)
    if "call" in config.tables:
        timed = ("threads", "thread_counts", "repeats", "warmup", "queries", "hz", "busy", "library")
        found = measure_call(policy, **{name: config[name] for name in timed})
        write_json(Path(config.out, "query.json"), found)
        plot_thread_scaling(found.threads_s, found.machine, Path(config.out, "query_threads.png"))
        print(f"\n{format_query_profile(found)}")
    if "engines" in config.tables:
        kept = Path(config.policy.removesuffix(".ckpt"), "bac.json")
        bac = BAC.from_pretrained(kept) if config.shape is None and kept.is_file() else None
        options = {name: config[name] for name in (*_ENGINES, "repeats", "warmup", "threads")}
        options |= {"name": config.shape or kept.parent.name, "bac": bac}
        profile_engines(policy.to(config.device), config.out, **options)


def profile_vla(config: DictConfig) -> None:
    refuse_unread(config, ("tables", *sorted({*_CALL} - {"engine"}), *_ENGINES), __file__, "of a VLA")
    if config.shape is None:
        refuse_unread(config, ("dtype",), __file__, "of a trained policy")
    with num_threads(config.threads), torch.no_grad():
        if config.shape is None:
            policy = load_vla(config, config.task).to(config.device)
        else:
            dtype = getattr(torch, config.dtype or "float32")
            policy = vla_cases.make_policy(config.shape, dtype=dtype, device=config.device)
            policy.engine = config.engine
        pruners = token_pruners(policy, config.alphas, config.shares, config.equal_to)
        case = vla_cases.VLACase(policy, pruners, config.instruction)
        rounds = {"repeats": config.repeats, "warmup": config.warmup}
        name = config.shape or Path(config.policy).name
        results = measure_vla(case, name=name, machine=describe_machine(config.device), **rounds)
    write_json(Path(config.out, "vla_latency.json"), results)
    plot_vla_times(results, Path(config.out, "vla_latency.png"))
    print(f"\n{format_vla_table(results)}")


if __name__ == "__main__":
    main()
