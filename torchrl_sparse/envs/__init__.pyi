from .robosuite import RobosuiteEnv as RobosuiteEnv
from .transforms import (
    EndEffectorVelocity as EndEffectorVelocity,
    make_env as make_env,
)
