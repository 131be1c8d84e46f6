from tests.fixtures.diffusion import make_network  # noqa: F401
