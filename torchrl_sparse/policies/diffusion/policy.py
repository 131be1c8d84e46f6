"""A diffusion policy as a TensorDict pipeline: encode the observations, plan what to skip, denoise a chunk of actions.

The planner only writes ``("diffusion", "prune_mask")``; the denoiser only reads it, and the planner's reuse rule. The
dense policy is the same pipeline with the `Dense` planner, so that every method is compared on one code path.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from pathlib import Path
from typing import Any, cast, get_args

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.blocks.engine.costs import BlockCost, engine_block_costs
from torchrl_sparse.blocks.engine.factory import EngineName
from torchrl_sparse.blocks.mask import MaskError, Reuse
from torchrl_sparse.blocks.planner import Dense, Planner, PlanSpec
from torchrl_sparse.blocks.saved import save_beside
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.denoiser import Denoiser
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.vision import VisionEncoder
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.policies.diffusion.denoiser import NOISES, ActionDenoiser, check_noise
from torchrl_sparse.policies.diffusion.describe import describe
from torchrl_sparse.policies.diffusion.encoder import ObservationEncoder
from torchrl_sparse.policies.diffusion.export import export_policy
from torchrl_sparse.policies.diffusion.kinds import check_kinds, check_trained
from torchrl_sparse.policies.diffusion.loading import LoadablePolicy
from torchrl_sparse.policies.diffusion.shortcut import answer_directly
from torchrl_sparse.policies.diffusion.warm_start import QueryStart, stored_start
from torchrl_sparse.runtime.clock import synchronised_clock
from torchrl_sparse.storage.convention import source_convention
from torchrl_sparse.storage.diffusion import RoundedEngine, StoredPolicy, write_pretrained


class DiffusionPolicy(LoadablePolicy):
    """Diffusion Policy (arXiv:2303.04137) with a transformer denoiser: encode -> plan -> denoise.

    Reads ``("history", "state")``, f32 [*B, n_obs_steps, Ds], and with ``vision`` the cameras' histories. The noise of a call
    follows from ``("episode", "seed")`` and ``("episode", "step")`` where the environment writes them (`RobosuiteEnv` does),
    else from torch's global generator. Writes the chunk, from the present step on, all that a table needs: see ``out_keys``.

    The next call sees weights that change, but for a part of a tensor written through ``.data``: call `refresh` then. `freeze`
    promises that none will. Frames that the call before has encoded (``("diffusion", "frame_features")``) keep its features.

    Args:
        network: the denoiser.
        normalizer: of states and actions.
        vision: encoder of the cameras; their features come before the state in the network's condition.
        sampler: of as many training steps as the network was trained with; DDPM with all of 100 by default.
        plan: the planner; None is dense.
        engine: what runs the denoising loop, see `torchrl_sparse.blocks.engine.make_engine`: ``"auto"`` (the
            fastest that applies), ``"native"``, ``"torch"`` or ``"reference"``. All give the same actions for the same mask and
            seed; ``"native_bf16"`` and ``"native_int8"`` round, the first the cameras' encoder too. In training mode, and where
            the condition requires gradients, the differentiable reference runs whatever is chosen.

    Attributes:
        plan: the planner. Assign another to change the method, or None for the dense policy, which then reads as `Dense`.
        sampler: the sampler. Assign another of the same training steps to change it: ``policy.sampler = Sampler("ddim", 10)``.
        start: what calls begin from: noise, the last chunk (`WarmStart`), or noise guided toward it (`RealtimeChunking`).
        source: where an imported policy comes from and how to feed it, see `StoredPolicy`; else empty.

    Examples:
        >>> from tensordict import TensorDict
        >>> policy = DiffusionPolicy.from_pretrained("assets/lift")
        >>> policy.sampler = Sampler("ddim", 10)
        >>> td = policy(TensorDict({"history": {"state": torch.zeros(4, 2, 19)}}, [4]))
        >>> td["vla_action", "chunk"].shape
        torch.Size([4, 9, 10])
    """

    def __init__(
        self,
        network: Denoiser,
        normalizer: Normalizer,
        *,
        vision: VisionEncoder | None = None,
        sampler: Sampler | None = None,
        plan: Planner | None = None,
        engine: EngineName = "auto",
    ):
        stages = OrderedDict(
            encode=ObservationEncoder(network, normalizer, vision),
            start=QueryStart(),
            plan=Dense(),
            denoise=ActionDenoiser(network, normalizer, sampler or Sampler(), engine),
        )
        super().__init__(stages)
        self.plan = plan  # it is bound to this network and sampler
        self.source: dict[str, Any] = {}
        self.engine = engine  # which decides how the cameras are encoded, too
        self.eval()

    @property
    def plan(self) -> Planner:
        return self.module["plan"]

    @plan.setter
    def plan(self, plan: Planner | None) -> None:
        self._install(plan, self.sampler, self.start)

    @property
    def start(self) -> QueryStart:
        return self.module["start"]

    @start.setter
    def start(self, start: QueryStart | None) -> None:
        self._install(self.plan, self.sampler, start)

    @property
    def sampler(self) -> Sampler:
        return self.module["denoise"].sampler

    @sampler.setter
    def sampler(self, sampler: Sampler) -> None:
        self._install(self.plan, sampler, self.start)

    def __setattr__(self, name: str, value: Any) -> None:
        # nn.Module registers any module that is assigned, so that of itself a property's setter would never see it.
        if name in ("plan", "start", "sampler", "noise"):
            object.__setattr__(self, name, value)
        else:
            super().__setattr__(name, value)

    def _install(self, plan: Planner | None, sampler: Sampler, start: QueryStart | None) -> None:
        """Change planner, sampler and start together, or, if one cannot serve that sampler, nothing."""
        plan, start = Dense() if plan is None else plan, QueryStart() if start is None else start
        check_kinds(plan=(plan, Planner), sampler=(sampler, Sampler), start=(start, QueryStart))
        check_trained(sampler, self.sampler)
        start.bind(self.network, self.normalizer, sampler)
        plan.bind(self._spec(sampler))
        denoise = self.module["denoise"]
        denoise.sampler = sampler
        denoise.warm, denoise.guided = keys.START in start.out_keys, keys.KNOWN in start.out_keys
        denoise.follow(plan)
        self.module["plan"], self.module["start"] = plan, start
        self.in_keys, out_keys = self._compute_in_and_out_keys([*self.module.values()])
        self.out_keys = [*out_keys, keys.LATENCY]

    def _spec(self, sampler: Sampler) -> PlanSpec:
        network = self.network
        of_sampler = sampler.num_inference_steps, network.n_layer, self.fingerprint, sampler.name
        return PlanSpec(*of_sampler, network.block_types)

    def with_plan(
        self, plan: Planner | None, sampler: Sampler | None = None, start: QueryStart | None = None
    ) -> DiffusionPolicy:
        """Return a policy with the same networks, another planner and start, and unless None another sampler.

        It is frozen if this one is.

        Raises:
            InputError: if the planner was made for another policy or sampler, the start cannot serve it, or the sampler counts
                other training steps.
        """
        same: dict[str, Any] = {"vision": self.vision, "sampler": self.sampler, "engine": self.engine}
        policy = DiffusionPolicy(self.network, self.normalizer, **same)
        policy.source = self.source
        policy.module["encode"].take_over(self.module["encode"])
        policy._install(plan, sampler or self.sampler, start)
        policy.noise = self.noise
        return policy.freeze() if self.frozen else policy

    def with_noise(self, stream: int) -> DiffusionPolicy:
        """Return the same policy with other random noise; ``stream`` 0 is every policy's default."""
        policy = self.with_plan(self.plan, start=self.start)
        policy.module["encode"].noise_stream = stream
        return policy

    @property
    def noise_stream(self) -> int:
        """Index of the noise stream from which episodes draw; see `with_noise`."""
        return self.module["encode"].noise_stream

    @property
    def noise(self) -> str:
        """Noise generator, one of `torchrl_sparse.policies.diffusion.denoiser.NOISES`; assign another to change it."""
        return self.module["denoise"].noise

    @noise.setter
    def noise(self, name: str) -> None:
        self.module["denoise"].noise = check_noise(name)

    @property
    def engine(self) -> EngineName:
        """The chosen engine; assign another name to change it."""
        return self.module["denoise"].engine.name

    @engine.setter
    def engine(self, name: EngineName) -> None:
        self.module["denoise"].choose(name)
        self.module["encode"].condition.bf16 = name == "native_bf16"

    def engine_info(self) -> str:
        """The engine and its device, e.g. ``"native: avx512, float32 weights, 2 threads"``, and why ``"auto"`` did not choose
        the native one. ValueError if the chosen engine cannot run this network here.
        """
        return self.module["denoise"].describe()

    describe = describe  # "observes the last 2 of\n  state, 19 numbers: …"

    def block_costs(self) -> dict[str, BlockCost]:
        """Return seconds, measured now, and FLOPs of one ``"SA"``, ``"CA"`` and ``"FFN"`` block in the engine, batch 1."""
        return engine_block_costs(self.module["denoise"].current_engine())

    def refresh(self) -> None:
        """Read all weights again at the next policy call, after writes that `Engine` says it cannot detect."""
        self.module["denoise"].refresh()
        self.module["encode"].refresh()
        self.plan.train(self.plan.training)  # a mode that is set has a learned planner forget what it keeps

    def sample_noise(self, seed: Tensor) -> Tensor:
        """Draw all noise, f32 [B, K, H, A], of the policy calls with ``seed``, i64 [B]."""
        return NOISES[self.noise](seed, self.num_inference_steps, (self.horizon, self.network.input_dim))

    def denoise(
        self, noise: Tensor, cond: Tensor, mask: Tensor | None = None, *, reuse: Reuse = "block"
    ) -> Tensor:
        """Return normalised actions f32 [B, H, A] from the current engine, see
        `torchrl_sparse.blocks.engine.Engine.denoise`.
        """
        return self.module["denoise"].run(noise, cond, mask, reuse)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        start = time.perf_counter()
        try:
            if answer_directly(start, self._parts, tensordict, *self.module.values()):
                return tensordict
            if (device := self.device).type != "cpu":
                start = synchronised_clock(device)
            # Made now: after the engine's call nothing is in the caches of what makes tensors.
            latency = torch.zeros(*tensordict.batch_size, 1, device=device)
            tensordict = super().forward(tensordict)
        except MaskError as error:
            raise InputError(f"{type(self.plan).__name__}: {error}") from error
        return tensordict.set(keys.LATENCY, latency.fill_(synchronised_clock(device) - start))

    def save_pretrained(self, path: str | Path, *, half: bool = True) -> None:
        """Write ``config.json``, weights (fp16 if ``half``, else fp32) and planner into the folder ``path``.

        An engine that rounds is kept, any other is the reader's choice.

        Raises:
            InputError: if the planner cannot be saved, see `torchrl_sparse.blocks.saved.save_beside`, or the start is neither
                None nor a `WarmStart`; nothing is written.
        """
        parts = self.network, self.normalizer, self.sampler, self.vision, self.source
        warm = stored_start(self.start)
        rounds = cast(RoundedEngine, self.engine) if self.engine in get_args(RoundedEngine) else None
        stored = StoredPolicy(*parts, save_beside(self.plan, Path(path)), warm, rounds)
        write_pretrained(Path(path), stored, half=half)

    def export(self, path: str | Path, *, weights: str = "float32") -> None:
        """Write one file that a robot runs in C; see `torchrl_sparse.policies.diffusion.export`, also for its limits."""
        facts = {"policy": self.fingerprint, "state_keys": self.source.get("state_keys")}
        facts["robosuite"] = source_convention(self.source)  # whose meaning the objects' state has
        export_policy(Path(path), *self.module.values(), weights=weights, facts=facts)
