"""What is captured as a CUDA graph, and when; a stand-in records it on the CPU."""

import pytest
import torch

from torchrl_sparse.blocks.engine import TorchEngine
from torchrl_sparse.networks.diffusion.sampler import Sampler

from .recorded_graph import RecordedGraph
from .test_engine import largest_error, make_masks, make_network, make_query


def captured_engine(network, sampler, graphs):
    """An engine on the CPU that believes to be on a GPU."""
    engine = TorchEngine(network, sampler)
    engine._current()[1].new_capture = lambda: graphs
    return engine


@pytest.mark.parametrize("shape", ["small", "condition layers"])
@pytest.mark.parametrize("reuse", ["block", "type", "single"])
def test_segments_can_be_captured_once_and_played_for_any_mask(shape, reuse):
    network, sampler, graphs = make_network(shape), Sampler("ddpm", 8), RecordedGraph()
    engine = captured_engine(network, sampler, graphs)
    made = []
    for seed, rate in enumerate([0.5, 0.9, 0.3]):
        query, masks = make_query(network, sampler, 3, seed), make_masks(network, sampler, 3, rate, seed)
        assert largest_error(engine, network, sampler, query, masks, reuse) < 1e-9
        same = masks[:1].repeat(3, 1, 1)
        assert largest_error(engine, network, sampler, query, same, reuse) < 1e-9
        made.append(len(graphs.graphs))
    # Each block for all rows and for some, the end of a step, and the memory if it depends on the step.
    assert made == [2 * network.num_blocks + 1 + (shape == "condition layers")] * 3


def test_a_captured_program_plays_its_computed_blocks_in_order():
    network, sampler, graphs = make_network("small"), Sampler("ddim", 5), RecordedGraph()
    engine, query = captured_engine(network, sampler, graphs), make_query(network, sampler, 1)
    masks = torch.ones(1, 5, network.num_blocks, dtype=torch.bool)
    masks[:, 0], masks[:, 2, 1], masks[:, 3, 4] = False, False, False
    assert largest_error(engine, network, sampler, query, masks) < 1e-9
    finish = network.num_blocks
    assert graphs.replays == [0, 1, 2, 3, 4, 5, finish, finish, 1, finish, 4, finish, finish]


@pytest.mark.parametrize("shape", ["small", "condition layers"])
@pytest.mark.parametrize("kind", ["ddpm", "ddim", "unipc"])
def test_a_dense_loop_is_one_graph(shape, kind):
    network, sampler, graphs = make_network(shape), Sampler(kind, 4), RecordedGraph()
    engine = captured_engine(network, sampler, graphs)
    for seed in range(3):
        assert largest_error(engine, network, sampler, make_query(network, sampler, 2, seed)) < 1e-9
    assert graphs.replays == [0, 0, 0]


def test_batches_are_padded_so_that_few_sizes_are_captured():
    """How many rows are due varies from policy call to call; each size that is captured takes dozens of graphs."""
    network, sampler, graphs = make_network("small"), Sampler("ddpm", 8), RecordedGraph()
    engine, made = captured_engine(network, sampler, graphs), {}
    for rows in (3, 4, 8, 5, 7, 6, 3):
        query, masks = make_query(network, sampler, rows, rows), make_masks(network, sampler, rows, 0.6, rows)
        assert largest_error(engine, network, sampler, query, masks) < 1e-9
        made[rows] = len(graphs.graphs)
    segments = 2 * network.num_blocks + 1
    assert made == {
        3: 2 * segments,
        4: segments,
        8: 2 * segments,
        5: 2 * segments,
        7: 2 * segments,
        6: 2 * segments,
    }


def test_every_workspace_has_a_pool_of_its_own():
    network, sampler, captures = make_network("small"), Sampler("ddim", 4), []
    engine = TorchEngine(network, sampler)
    engine._current()[1].new_capture = lambda: captures.append(RecordedGraph()) or captures[-1]
    for rows in (1, 2, 1):
        assert largest_error(engine, network, sampler, make_query(network, sampler, rows)) < 1e-9
    assert [len(capture.graphs) for capture in captures] == [1, 1]


class FailsOnce(RecordedGraph):
    """Fails in the middle of its first capture, as a device without memory would."""

    fail = True

    def __call__(self, segment):
        if len(self.graphs) == 2 and FailsOnce.fail:
            FailsOnce.fail = False
            segment()
            raise RuntimeError("out of memory")
        return super().__call__(segment)


def test_a_capture_that_failed_is_tried_again():
    network, sampler = make_network("small"), Sampler("ddpm", 8)
    engine = TorchEngine(network, sampler)
    engine._current()[1].new_capture = FailsOnce
    query, masks = make_query(network, sampler, 2), make_masks(network, sampler, 2, 0.6)
    with pytest.raises(RuntimeError, match="out of memory"):
        engine.denoise(*query, masks)
    assert largest_error(engine, network, sampler, query, masks) < 1e-9


def test_autocast_does_not_reach_a_capture():
    network, sampler, graphs = make_network("small").float(), Sampler("ddpm", 8), RecordedGraph()
    engine = captured_engine(network, sampler, graphs)
    query, masks = make_query(network, sampler, 2), make_masks(network, sampler, 2, 0.6)
    with torch.autocast("cpu"):
        assert torch.equal(engine.denoise(*query, masks), engine.denoise(*query, masks))
    operations = [func for calls in graphs.graphs for func, *_ in calls]
    assert not any("_to_copy" in str(func) for func in operations)
    assert largest_error(engine, network, sampler, query, masks) < 1e-4
