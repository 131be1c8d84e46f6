from .for_policy import diffusion_env as diffusion_env
from .instructed import instructed_env as instructed_env
from .robosuite import RobosuiteEnv as RobosuiteEnv
from .transforms import (
    EndEffectorVelocity as EndEffectorVelocity,
    make_env as make_env,
)
