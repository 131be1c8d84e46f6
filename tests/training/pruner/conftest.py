from tests.blocks.conftest import ddpm, network, query, sampler  # noqa: F401
