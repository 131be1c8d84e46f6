import pytest
import torch

pytest.importorskip("transformers")


@pytest.fixture(autouse=True)
def _without_gradients():
    with torch.no_grad():
        yield
