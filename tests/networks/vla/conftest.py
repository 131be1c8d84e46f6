from tests.fixtures.vla import config, network, policy, query  # noqa: F401
