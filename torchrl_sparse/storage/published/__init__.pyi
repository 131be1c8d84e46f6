from .diffusion_policy import (
    CheckpointError as CheckpointError,
    read_diffusion_policy as read_diffusion_policy,
)
from .openvla_oft import read_openvla_oft as read_openvla_oft
