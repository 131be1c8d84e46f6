from tests.fixtures.diffusion import demos, make_network  # noqa: F401
