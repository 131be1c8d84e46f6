"""A vision-language-action network compiled by OpenVINO, part by part: towers, head, and each stretch of decoder layers.

What a pruner reads or drops lies between two stretches, so that each has one compiled part, whose batch and number of tokens
may be any. Parts are traced from the network's own modules when they are first needed; no code is read from a file.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Hashable, Sequence
from functools import cache
from importlib.util import find_spec
from threading import Lock
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.vla.decoder import Ran, Rotary, run_stretch
from torchrl_sparse.networks.vla.network import VLANetwork

__all__ = ["OpenVINOVLA", "openvino_supports"]

_Make = Callable[[VLANetwork], nn.Module]
_TOKENS = 7  # of the examples that parts are traced with


@cache
def _is_installed() -> bool:
    return find_spec("openvino") is not None


def openvino_supports(network: VLANetwork) -> tuple[bool, str]:
    """Return whether OpenVINO can run ``network`` here, and if not, why."""
    if not _is_installed():
        return False, "needs the extra openvino, pip install 'torchrl-sparse[openvino]'"
    for weight in network.parameters():
        if weight.device.type != "cpu" or weight.dtype != torch.float32:
            return False, f"expected float32 weights on a CPU, got {weight.dtype} on {weight.device}"
    return True, ""


class OpenVINOVLA:
    """Computes the parts of a `VLANetwork` with the weights that it had when this was made, in float32.

    Args:
        network: one that `openvino_supports`.
        threads: of the processor.

    Raises:
        InputError: if it cannot be run here; the message says why.
    """

    def __init__(self, network: VLANetwork, threads: int = 1) -> None:
        applies, reason = openvino_supports(network)
        if not applies:
            raise InputError(f"openvino engine: {reason}")
        import openvino

        self._network, self._threads, self._core = network, threads, openvino.Core()
        self._parts: dict[Hashable, _Part] = {}
        self._making = Lock()

    def visual_tokens(self, images: Tensor) -> Tensor:
        """Return the visual tokens [B, N, d] of images u8 [B, cameras, 3, h, w]."""
        frames = images.flatten(0, 1)
        tokens = self._run("vision", _Vision, (frames,))[0]
        return tokens.unflatten(0, images.shape[:2]).flatten(1, 2)

    def run_layers(
        self, layers: Sequence[int], hidden: Tensor, rotary: Rotary, mask: Tensor | None, scored: bool
    ) -> Ran:
        """Run a stretch of the decoder's layers, see `BidirectionalLlama.run_layers`."""
        inputs = (hidden, *rotary) if mask is None else (hidden, *rotary, mask)
        key = (tuple(layers), scored, mask is None)
        outputs = self._run(key, lambda net: _Stretch(net, layers, scored), inputs, any_tokens=True)
        if not scored:
            return Ran(outputs[0], outputs[0], outputs[0], outputs[0])
        last, query, key, *before = outputs
        return Ran(last, before[0] if before else hidden, query, key)

    def read_actions(self, readout: Tensor) -> Tensor:
        """Return the actions [B, H, A] of decoder outputs [B, H * A, d]."""
        return self._run("head", lambda network: network.head, (readout,))[0]

    def _run(
        self, key: Hashable, make: _Make, inputs: tuple[Tensor, ...], any_tokens: bool = False
    ) -> list[Tensor]:
        part = self._parts.get(key)
        if part is None:
            with self._making:
                if (part := self._parts.get(key)) is None:
                    compiled = self._compile(_converted(make(self._network), inputs, any_tokens))
                    part = self._parts[key] = _Part(compiled)
        return part(inputs)

    def _compile(self, model: Any) -> Any:
        properties = {
            "INFERENCE_PRECISION_HINT": "f32",  # some processors round to bfloat16 unless told
            "INFERENCE_NUM_THREADS": self._threads,
            "NUM_STREAMS": 1,
            "ENABLE_CPU_PINNING": False,
        }
        return self._core.compile_model(model, "CPU", properties)


class _Vision(nn.Module):
    """From frames u8 [B * cameras, 3, h, w] to their visual tokens."""

    def __init__(self, network: VLANetwork) -> None:
        super().__init__()
        self.vision, self.projector = network.vision, network.projector

    def forward(self, frames: Tensor) -> Tensor:
        return self.projector(self.vision(frames))


class _Stretch(nn.Module):
    """Some of the decoder's layers, as `BidirectionalLlama.run_layers` runs them."""

    def __init__(self, network: VLANetwork, layers: Sequence[int], scored: bool) -> None:
        super().__init__()
        self.layers = nn.ModuleList(network.decoder.llama.layers[index] for index in layers)
        self.head_dim, self.scored = network.decoder.head_dim, scored

    def forward(self, hidden: Tensor, cos: Tensor, sin: Tensor, mask: Tensor | None = None) -> Any:
        ran = run_stretch(self.layers, hidden, (cos, sin), mask, self.head_dim)
        if not self.scored:
            return ran.hidden
        read = ran.hidden, ran.query, ran.key
        return read if len(self.layers) == 1 else (*read, ran.before)


class _Part:
    """One compiled part; calls of several threads come one after the other."""

    def __init__(self, compiled: Any) -> None:
        import openvino

        self._tensor = openvino.Tensor
        self._request, self._outputs = compiled.create_infer_request(), len(compiled.outputs)
        self._running = Lock()

    def __call__(self, inputs: tuple[Tensor, ...]) -> list[Tensor]:
        arrays = [tensor.detach().contiguous().numpy() for tensor in inputs]
        with self._running:
            for index, array in enumerate(arrays):
                self._request.set_input_tensor(index, self._tensor(array, shared_memory=True))
            self._request.infer(share_outputs=True)
            # Copied: the next call writes where this one did.
            found = (self._request.get_output_tensor(index).data for index in range(self._outputs))
            return [torch.from_numpy(array).clone() for array in found]


@torch.no_grad()
def _converted(module: nn.Module, inputs: tuple[Tensor, ...], any_tokens: bool) -> Any:
    """Return OpenVINO's model of a module, for any batch and, where ``any_tokens``, number of tokens.

    Args:
        inputs: of the first call.
    """
    import openvino
    from openvino.frontend import FrontEndManager
    from openvino.frontend.pytorch.ts_decoder import TorchScriptPythonDecoder

    sizes = [_sizes(tensor, any_tokens) for tensor in inputs]
    examples = tuple(_example(tensor, size) for tensor, size in zip(inputs, sizes, strict=True))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a tracer that is deprecated, and that what is fixed is fixed
        traced = torch.jit.freeze(torch.jit.trace(module.eval(), examples, check_trace=False))
        decoder = TorchScriptPythonDecoder(traced, example_input=examples)
        frontend = FrontEndManager().load_by_framework("pytorch")
        model = frontend.convert(frontend.load(decoder))
    kinds = {
        torch.float32: openvino.Type.f32,
        torch.uint8: openvino.Type.u8,
        torch.bool: openvino.Type.boolean,
    }
    for parameter, tensor, size in zip(model.get_parameters(), inputs, sizes, strict=True):
        parameter.set_element_type(kinds[tensor.dtype])
        parameter.set_partial_shape(openvino.PartialShape(size))
    model.validate_nodes_and_infer_types()
    return model


def _sizes(tensor: Tensor, any_tokens: bool) -> list[int]:
    """Return the sizes of an input, -1 where they may be any."""
    sizes = [-1, *tensor.shape[1:]]
    if any_tokens:
        sizes[-1 if tensor.dtype == torch.bool else 1] = -1  # a mask's last, [B, 1, 1, S]
    return sizes


def _example(tensor: Tensor, sizes: list[int]) -> Tensor:
    return torch.ones(2, *(_TOKENS if size == -1 else size for size in sizes[1:]), dtype=tensor.dtype)
