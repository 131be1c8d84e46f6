import pytest

from tests.refusals import refused
from torchrl_sparse.evaluation.statistics.ways import way_entropy


@pytest.mark.parametrize(
    ("ways", "bits"),
    [([2, 2, 2], 0.0), ([0, 1, 2, 3] * 5, 2.0), ([0, 0, 0, 1], 0.811278), ([-1, 1, -1, 0, -1], 1.0)],
)
def test_entropy_of_known_frequencies(ways, bits):
    assert way_entropy(ways) == pytest.approx(bits, abs=1e-6)


@pytest.mark.parametrize("ways", [[], [-1, -1]])
def test_no_way_has_no_entropy(ways):
    with refused("ways"):
        way_entropy(ways)
