from .diffusion_policy import read_diffusion_policy as read_diffusion_policy
from .faults import CheckpointError as CheckpointError
from .openvla_oft import read_openvla_oft as read_openvla_oft
