from .published import (
    CheckpointError as CheckpointError,
    load_openvla_oft as load_openvla_oft,
    read_diffusion_policy as read_diffusion_policy,
)
