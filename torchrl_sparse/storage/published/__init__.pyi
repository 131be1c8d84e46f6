from .diffusion_policy import (
    CheckpointError as CheckpointError,
    read_diffusion_policy as read_diffusion_policy,
)
from .openvla_oft import load_openvla_oft as load_openvla_oft
