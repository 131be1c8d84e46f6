"""Every shipped method answers as it did when `tests.pinned.record` was last run."""

import numpy as np
import pytest
import torch

from tests.pinned import actions, build
from tests.pinned.record import load_actions, packed

CASES = [*actions.cases()]
NATIVE, REASON = build.native_available()


@pytest.fixture(scope="module")
def stored():
    return load_actions()


def test_what_is_shipped_is_pinned(stored):
    assert {str(case) for case in CASES} == stored.keys()


@pytest.mark.parametrize("case", CASES, ids=str)
def test_answers_stay(case, stored):
    if case.engine == "native" and not NATIVE:
        pytest.skip(REASON)
    found, pinned = packed(case.answer()), stored[str(case)]
    assert found.keys() == pinned.keys()
    assert [value.shape for value in found.values()] == [pinned[name].shape for name in found]
    differing = differences(found["mask"], pinned["mask"])
    assert differing.sum() <= case.rounding, f"bits of the mask that differ, of each query: {differing}"
    same = torch.from_numpy(differing == 0)
    assert torch.equal(found["flops"][same], pinned["flops"][same])
    torch.testing.assert_close(found["chunk"][same], pinned["chunk"][same], rtol=0, atol=case.tolerance)
    if "seed" in pinned:
        assert torch.equal(found["seed"], pinned["seed"])


def differences(found: torch.Tensor, pinned: torch.Tensor) -> np.ndarray:
    """How many bits of two packed masks [Q, bytes] differ, of each policy call."""
    return np.unpackbits(found.numpy() ^ pinned.numpy(), axis=1).sum(1)
