from .candidates import (
    Grid as Grid,
    calibrate_candidates as calibrate_candidates,
)
from .deliver import (
    film_chosen as film_chosen,
    save_policy as save_policy,
    write_acceleration_report as write_acceleration_report,
)
from .request import Request as Request
from .run import accelerate as accelerate
