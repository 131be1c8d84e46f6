"""The files that are read: a valid one of each kind, its reader, and the document in it that the grammar changes."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable, Iterator
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any, get_args, get_type_hints

import torch

from tests.evaluation.results.test_realtime import DENSE, FAST, build
from tests.evaluation.synthetic import make_results
from torchrl_sparse.blocks.mask import mask_from_steps
from torchrl_sparse.blocks.planner import Planner
from torchrl_sparse.blocks.sag.network import PrunerNetwork
from torchrl_sparse.blocks.sag.planner import PrunerInfo, SAGPruner
from torchrl_sparse.blocks.saved import load_planner
from torchrl_sparse.blocks.schedule import CacheSchedule
from torchrl_sparse.cli.sweeps import LocalSweep, SavedSweep, Trial
from torchrl_sparse.evaluation.results.realtime import Realtime, load_realtime
from torchrl_sparse.evaluation.results.schema import Results, load_results, save_results
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeLog, EpisodeResult
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.storage.json import write_json

SWEEP = {
    "program": "trial.py",
    "method": "grid",
    "parameters": {"n": {"values": [1, 2]}},
    "command": ["python", "${program}", "${args_no_hyphens}"],
}
IDENTITY = {"method": "dense", "task": "lift"}


@dataclass(frozen=True)
class Format:
    """A kind of file.

    Attributes:
        name: of the kind.
        write: writes a valid one into an empty folder.
        read: reads what lies in that folder.
        file: that is changed, within the folder.
        free: keys below which a file may hold anything.
        optional: keys that it need not have.
        sections: keys whose entries are arguments of a constructor: an error names the argument or the section.
        line: which line of the file the document is; None where it is the whole file. Lines that a kill tore are answered.
    """

    name: str
    write: Callable[[Path], None]
    read: Callable[[Path], Any]
    file: str
    free: set[str] = field(default_factory=set)
    optional: set[str] = field(default_factory=set)
    sections: set[str] = field(default_factory=set)
    line: int | None = None

    def document(self, folder: Path) -> dict[str, Any]:
        """Return the valid document."""
        text = (folder / self.file).read_text()
        return json.loads(text if self.line is None else text.splitlines()[self.line])

    def put(self, folder: Path, document: Any) -> None:
        """Put a document in its place."""
        path, text = folder / self.file, json.dumps(document)
        if self.line is not None:
            lines = path.read_text().splitlines()
            lines[self.line] = text
            text = "\n".join(lines) + "\n"
        path.write_text(text)


def defaulted(kind: Any) -> set[str]:
    """Return the keys with a default in a dataclass that is a file's schema, and in those that it holds."""
    if not is_dataclass(kind):
        return set().union(*map(defaulted, get_args(kind)))
    own = {
        entry.name for entry in fields(kind) if (entry.default, entry.default_factory) != (MISSING, MISSING)
    }
    return own.union(*map(defaulted, get_type_hints(kind).values()))


def small_policy(engine: str = "auto") -> DiffusionPolicy:
    """Return a policy for Lift that answers in milliseconds."""
    torch.manual_seed(0)
    network = TransformerForDiffusion(
        input_dim=10, output_dim=10, horizon=10, n_obs_steps=2, cond_dim=19, n_layer=2, n_emb=16
    )
    return DiffusionPolicy(
        network.eval(),
        Normalizer(torch.ones(19), torch.zeros(19), torch.ones(10), torch.zeros(10)),
        engine=engine,
    )


def small_pruner(policy: str = "a policy") -> SAGPruner:
    """Return a pruner of a short chain."""
    torch.manual_seed(0)
    network = PrunerNetwork([3, 2, 1, 0], num_blocks=6, cond_shape=(2, 5), width=8, hidden=8, obs_width=8)
    return SAGPruner(network, PrunerInfo(policy, "ddim", rate=0.7))


def _schedule(folder: Path) -> None:
    mask = mask_from_steps([[0, 2], [0], [0, 1, 3]], num_steps=4)
    CacheSchedule.from_mask(mask, method="bac", policy="a policy", settings={"top_k": 5}).save_pretrained(
        folder / "bac.json"
    )


def _log(folder: Path) -> None:
    log = EpisodeLog(folder / "dense.jsonl", IDENTITY)
    for seed in range(3):
        log.append(EpisodeResult(seed, True, 30, 2, 6.3e10, 0.5, (0.1, 0.2), (3.0, 4.0), (True, False)))


def _sweep(folder: Path) -> None:
    trials = Trial("s-1", {"n": 1}, True), Trial("s-2", {"n": 2})
    write_json(folder / "sweep.json", SavedSweep(SWEEP, trials))


def _vla(folder: Path) -> None:
    from torchrl_sparse.networks.vla.config import VLAConfig
    from torchrl_sparse.networks.vla.network import VLANetwork
    from torchrl_sparse.networks.vla.normalize import QuantileNormalizer
    from torchrl_sparse.networks.vla.text import WordTokenizer
    from torchrl_sparse.policies.vla.policy import VLAPolicy

    network = VLANetwork(VLAConfig.tiny()).eval()
    normalizer = QuantileNormalizer.identity(network.config.state_dim, network.config.action_dim)
    VLAPolicy(network, normalizer, WordTokenizer(["lift"])).save_pretrained(folder)


def _read_vla(folder: Path) -> Any:
    from torchrl_sparse.policies.vla.policy import VLAPolicy

    return VLAPolicy.from_pretrained(folder)


def _read_planner(name: str, folder: Path) -> Planner:
    return load_planner(folder / name)


_POLICY_DEFAULTS = {"n_layer", "n_head", "n_emb", "p_drop_emb", "p_drop_attn", "causal_attn", "n_cond_layers"}
_PRUNER_DEFAULTS = {"width", "obs_width", "hidden", "n_layer", "n_head", "rate_input"}

JSON_FORMATS = [
    Format(
        "config.json of a policy",
        lambda folder: small_policy().save_pretrained(folder),
        DiffusionPolicy.from_pretrained,
        "config.json",
        optional={*_POLICY_DEFAULTS, "kind", "num_inference_steps", "num_train_timesteps"},
        sections={"network", "schedule"},
    ),
    Format("cache schedule", _schedule, partial(_read_planner, "bac.json"), "bac.json", free={"settings"},
           sections={"computed_steps"}),
    Format(
        "config.json of a pruner",
        lambda folder: small_pruner().save_pretrained(folder / "sag"),
        partial(_read_planner, "sag"),
        "sag/config.json",
        free={"settings"},
        optional={*_PRUNER_DEFAULTS, *defaulted(PrunerInfo)},
        sections={"network"},
    ),
    Format(
        "results.json",
        lambda folder: save_results(make_results(20, names=("dense", "bac")), folder / "results.json"),
        lambda folder: load_results(folder / "results.json"),
        "results.json",
        free={"success_within"},
        optional={"bac", *defaulted(Results)},
    ),
    Format(
        "realtime.json",
        lambda folder: write_json(folder / "realtime.json", build(dense=DENSE, bac=FAST)),
        lambda folder: load_realtime(folder / "realtime.json"),
        "realtime.json",
        optional={"dense", "bac", *defaulted(Realtime)},
    ),
    Format(
        "sweep.json",
        _sweep,
        lambda folder: LocalSweep(SWEEP, folder),
        "sweep.json",
        free={"config", "parameters"},
        optional=defaulted(SavedSweep),
    ),
    Format("head of an episode log", _log, lambda f: EpisodeLog(f / "dense.jsonl", IDENTITY), "dense.jsonl",
           free={"identity"}, line=0),
    Format("episode in a log", _log, lambda f: EpisodeLog(f / "dense.jsonl", IDENTITY), "dense.jsonl",
           optional=defaulted(EpisodeResult), line=2),
]  # fmt: skip


def json_formats() -> Iterator[Format]:
    """Yield the kinds that this installation can read."""
    yield from JSON_FORMATS
    if importlib.util.find_spec("transformers"):
        yield Format(
            "config.json of a VLA",
            _vla,
            _read_vla,
            "config.json",
            free={"cameras"},
            sections={"network", "tokenizer"},
        )
