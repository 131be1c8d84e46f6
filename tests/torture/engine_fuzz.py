"""Engines and the pruner's compiled MLP under random calls, right and wrong ones, against the reference in double precision.

    python -m tests.torture.engine_fuzz seed=0 queries=200 seconds=300

With ``SANITIZED_NATIVE``, as `make sanitize` sets it, the first error of memory ends the process.
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from torch import Tensor

from tests.blocks.engine.conftest import SANITIZED  # and puts that library in the place of the installed one
from tests.torture.report import Verdict
from torchrl_sparse.blocks.engine import denoise, make_engine, native_available
from torchrl_sparse.blocks.engine.native.pruner import MAX_HIDDEN
from torchrl_sparse.blocks.mask import REUSE_RULES
from torchrl_sparse.blocks.sag.network import PrunerNetwork
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

RIGHT, WRONG = (
    "a random policy call is answered as by the reference",
    "a wrong policy call is answered or refused",
)
TOLERANCE = 2e-4
"""Largest difference to double precision, of actions in [-1, 1]."""

_REFUSALS = (ValueError, TypeError)
_LAST = 240.0  # seconds that the last policy call may take, and the start


@dataclass
class Query:
    """Arguments of an engine's ``denoise``."""

    noise: Any
    cond: Any
    mask: Any
    reuse: Any

    def answer(self, engine: Any) -> Tensor:
        """Ask the engine."""
        return engine.denoise(self.noise, self.cond, self.mask, self.reuse)


def fuzz(seed: int, queries: int) -> Iterator[Verdict]:
    """Ask every engine random policy calls, then wrong ones, and prune random observations."""
    engines = ["torch", *(["native"] if native_available()[0] else [])]
    for number in range(queries):
        rng = random.Random(f"{seed}:{number}")
        torch.manual_seed(rng.randrange(2**31))
        name = rng.choice(engines) if number % 4 else "native" if "native" in engines else "torch"
        network, sampler = _network(rng), _sampler(rng)
        case = f"seed {seed}:{number}, {sampler.name}, {network.config}"
        yield Verdict(RIGHT, f"{name} engine", case, _differs(name, network, sampler, rng))
        how, fault = _mistreat(name, network, sampler, rng)
        yield Verdict(WRONG, f"{name} engine", f"{case}, {how}", fault)
        case, fault = _prune(rng)
        yield Verdict(RIGHT, "the pruner's MLP", f"seed {seed}:{number}, {case}", fault)


def _network(rng: random.Random) -> TransformerForDiffusion:
    heads, actions = rng.choice([1, 2, 3, 4]), rng.choice([1, 2, 7, 10, 17])
    network = TransformerForDiffusion(
        input_dim=actions,
        output_dim=actions,
        horizon=rng.choice([1, 2, 3, 7, 10, 16, 33]),
        n_obs_steps=rng.choice([1, 2, 3, 9]),
        cond_dim=rng.choice([1, 3, 19, 65]),
        n_layer=rng.choice([1, 2, 3]),
        n_head=heads,
        n_emb=2 * heads * rng.choice([2, 3, 8, 13]),
        causal_attn=rng.random() < 0.8,
    )
    for name, parameter in network.named_parameters():
        torch.nn.init.normal_(parameter, mean=float("norm" in name and "weight" in name), std=0.08)
    return network.eval().requires_grad_(False)


def _sampler(rng: random.Random) -> Sampler:
    if rng.random() < 0.3:
        return Sampler("ddim", timesteps=sorted(rng.sample(range(100), rng.randint(1, 8)), reverse=True))
    return Sampler(rng.choice(["ddpm", "ddim"]), rng.randint(1, 12))


def _query(network: TransformerForDiffusion, sampler: Sampler, rng: random.Random) -> Query:
    batch, steps = rng.choice([0, 1, 1, 2, 3, 5, 17]), sampler.num_inference_steps
    mask = torch.rand(batch, steps, network.num_blocks) < rng.choice([0.0, 0.3, 0.9, 1.1])
    mask[:, 0] = False
    return Query(
        torch.randn(batch, steps, network.horizon, network.input_dim),
        torch.randn(batch, network.n_obs_steps, network.cond_dim) * rng.choice([0.0, 1.0, 30.0]),
        rng.choice([None, mask, mask]),
        rng.choice(REUSE_RULES),
    )


def _differs(name: str, network: TransformerForDiffusion, sampler: Sampler, rng: random.Random) -> str | None:
    query = _query(network, sampler, rng)
    try:
        actions = query.answer(make_engine(name, network, sampler))
        network.double()
        exact = denoise(
            network, sampler, query.noise.double(), query.cond.double(), query.mask, reuse=query.reuse
        )
    except Exception as error:
        return f"batch {len(query.noise)}: expected actions, got {type(error).__name__}: {str(error)[:200]!r}"
    finally:
        network.float()
    error = (actions - exact).abs().max().item() if len(actions) else 0.0
    return None if error < TOLERANCE and actions.shape == exact.shape else f"differs by {error:.3g}"


def _mistreat(
    name: str, network: TransformerForDiffusion, sampler: Sampler, rng: random.Random
) -> tuple[str, str | None]:
    query, engine = _query(network, sampler, rng), make_engine(name, network, sampler)
    how = rng.choice(list(WRONGS))
    WRONGS[how](query)
    try:
        actions = query.answer(engine)
    except _REFUSALS as error:
        return how, "expected one line" if "\n" in str(error) else None
    except Exception as error:
        return how, f"expected an answer or a refusal, got {type(error).__name__}: {str(error)[:200]!r}"
    shape = (len(query.cond), network.horizon, network.input_dim)
    return how, None if tuple(
        actions.shape
    ) == shape else f"expected actions {shape}, got {tuple(actions.shape)}"


def _set(field: str, change: Callable[[Any], Any]) -> Callable[[Query], None]:
    return lambda query: setattr(query, field, change(getattr(query, field)))


def _ones(query: Query) -> None:
    query.mask = torch.ones(len(query.noise), query.noise.shape[1], 3, dtype=torch.bool)


WRONGS: dict[str, Callable[[Query], None]] = {
    f"{field} {how}": _set(field, change)
    for field in ("noise", "cond")
    for how, change in {
        "in double": Tensor.double,
        "in half": Tensor.half,
        "of integers": Tensor.long,
        "complex": lambda value: value.to(torch.complex64),
        "without the last number": lambda value: value[..., :-1],
        "without the first step": lambda value: value[:, 1:],
        "one row longer": lambda value: torch.cat([value, value, value[:1]]),
        "with one more axis": lambda value: value[None],
        "flat": Tensor.flatten,
        "a number": lambda value: torch.tensor(1.0),
        "meta": lambda value: value.to("meta"),
        "sparse": Tensor.to_sparse,
        "as numpy": Tensor.numpy,
        "as a list": Tensor.tolist,
        "nothing": lambda value: None,
        "backwards in memory": lambda value: value.transpose(0, -1).contiguous().transpose(0, -1),
        "a view within another": lambda value: torch.cat([value, value], -1)[..., : value.shape[-1]],
        "that wants gradients": lambda value: value.clone().requires_grad_(),
        "not finite": lambda value: value * float("nan"),
        "infinite": lambda value: value.abs() / 0,
        "of 1e38": lambda value: value * 1e38,
    }.items()
} | {
    "a mask of three columns": _ones,
    "a mask of integers": _set("mask", lambda mask: torch.zeros(1, 1, 3, dtype=torch.int64)),
    "a mask on meta": _set("mask", lambda mask: None if mask is None else mask.to("meta")),
    "a mask that is sparse": _set("mask", lambda mask: None if mask is None else mask.to_sparse()),
    "a mask that prunes the first step": _set(
        "mask", lambda mask: None if mask is None else torch.ones_like(mask)
    ),
    "a mask of one row for all": _set("mask", lambda mask: None if mask is None else mask[:1]),
    "a mask as a list": _set("mask", lambda mask: None if mask is None else mask.tolist()),
    "a mask with steps backwards": _set("mask", lambda mask: None if mask is None else mask.flip(-1)),
    "an unknown rule": _set("reuse", lambda reuse: "layer"),
    "a rule that is None": _set("reuse", lambda reuse: None),
    "a rule that is a number": _set("reuse", lambda reuse: 3),
    "a rule that is a list": _set("reuse", lambda reuse: [reuse]),
}


def _prune(rng: random.Random) -> tuple[str, str | None]:
    """Compare the compiled MLP, which `PrunerNetwork` uses, with both logits in double precision."""
    shape, steps = (rng.choice([1, 2, 3]), rng.choice([1, 5, 23, 150])), rng.choice([1, 2, 7, 30])
    sizes = {
        "hidden": rng.choice([1, 2, 8, 45, MAX_HIDDEN]),
        "obs_width": rng.choice([1, 3, 64]),
        "width": rng.choice([4, 16]),
    }
    rated, blocks = rng.random() < 0.5, rng.choice([3, 6, 9, 24])
    network = PrunerNetwork(range(steps - 1, -1, -1), blocks, shape, rate_input=rated, **sizes).eval()
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    rows = rng.choice([0, 1, 2, 5, 17])
    cond, rate = torch.randn(rows, *shape), torch.rand(rows, 1) if rated else None
    case = f"{rows} rows, {steps} steps, {network.config}"
    try:
        with torch.no_grad():
            logits = network.prune_logits(cond, rate)
            both = network.double()(cond.double(), None if rate is None else rate.double())
    except Exception as error:
        return case, f"expected logits, got {type(error).__name__}: {str(error)[:200]!r}"
    exact = both[..., 1] - both[..., 0]
    scale = max(1.0, exact.abs().max().item()) if rows else 1.0
    error = (logits - exact).abs().max().item() / scale if rows else 0.0
    return case, None if error < TOLERANCE and logits.shape == exact.shape else f"differs by {error:.3g}"


def torture_engines(seed: int, queries: int, library: Path | None, seconds: float) -> Iterator[Verdict]:
    """Fuzz in a process of its own, under the sanitizers where their library is given; the process' end is a case too.

    Args:
        seconds: after which no further policy call is asked.
    """
    words = (f"seed={seed}", f"queries={queries}", f"seconds={seconds}")
    command = [sys.executable, "-m", "tests.torture.engine_fuzz", *words]
    environment = os.environ | (_sanitizers(library) if library else {})
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=seconds + _LAST
        )
        output, fault = done.stdout, done.stderr[-300:] if done.returncode else None
    except subprocess.TimeoutExpired as late:
        output, fault = (late.stdout or b"").decode(), f"did not end within {seconds + _LAST:.0f} s"
    for line in output.splitlines():
        yield Verdict(**json.loads(line))
    yield Verdict(
        "no error of memory, no hang",
        "sanitized library" if library else "installed library",
        f"seed {seed}",
        fault,
    )


def _sanitizers(library: Path) -> dict[str, str]:
    names = ("libasan.so", "libubsan.so")
    found = [
        subprocess.check_output(["g++", f"-print-file-name={name}"], text=True).strip() for name in names
    ]
    return {"LD_PRELOAD": " ".join(found), "ASAN_OPTIONS": "detect_leaks=0", "SANITIZED_NATIVE": str(library)}


if __name__ == "__main__":
    options = OmegaConf.from_cli()
    until = time.monotonic() + options.seconds
    for verdict in fuzz(options.seed, options.queries):
        print(json.dumps(vars(verdict)), flush=True)
        if time.monotonic() > until:
            break
    if SANITIZED and SANITIZED not in Path("/proc/self/maps").read_text():
        sys.exit(f"expected the engine's library to be {SANITIZED}, it was never loaded")
