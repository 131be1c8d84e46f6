import pytest

from .checkpoints import LowDimPolicy, write_checkpoint


@pytest.fixture(scope="session")
def published():
    return LowDimPolicy()


@pytest.fixture(scope="session")
def checkpoint(published, tmp_path_factory):
    return write_checkpoint(tmp_path_factory.mktemp("published") / "latest.ckpt", published)
