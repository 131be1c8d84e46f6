from tests.fixtures.diffusion import demos, make_image_demos, make_network  # noqa: F401
from tests.policies.diffusion.conftest import make_image_policy, policy  # noqa: F401
