"""A CUDA graph's stand-in on a CPU."""

from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

# A graph cannot wait for the device, and so cannot depend on a value.
FORBIDDEN = {"aten._local_scalar_dense.default", "aten.nonzero.default", "aten.item.default"}


class _Recorder(TorchDispatchMode):
    def __init__(self, calls):
        super().__init__()
        self.calls = calls

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        assert str(func) not in FORBIDDEN, f"{func} in a capture"
        result = func(*args, **(kwargs or {}))
        self.calls.append((func, args, kwargs or {}, result))
        return result


class RecordedGraph:
    """Records which operations a function launches, on which memory and with which numbers, and replays just those.

    Like a capture it needs warm-up calls, and like a graph it runs no Python and allocates nothing that stays: what was
    allocated while it was recorded lies where it lay. ``graphs`` has all that were made, ``replays`` their order.
    """

    graphs: list
    replays: list

    def __init__(self):
        self.graphs, self.replays = [], []

    def __call__(self, segment):
        for _ in range(3):
            segment()
        calls, name = [], len(self.graphs)
        with _Recorder(calls):
            segment()
        self.graphs.append(calls)

        def replay():
            self.replays.append(name)
            for func, args, kwargs, recorded in calls:
                result = func(*args, **kwargs)
                for old, new in zip(tree_leaves(recorded), tree_leaves(result), strict=True):
                    if old.data_ptr() != new.data_ptr():
                        old.copy_(new)

        return replay
