from .published import (
    CheckpointError as CheckpointError,
    read_diffusion_policy as read_diffusion_policy,
)
