from .base import Expert as Expert
from .demonstrators import (
    Demonstrator as Demonstrator,
    RobosuiteDemonstrator as RobosuiteDemonstrator,
    StateDemonstrator as StateDemonstrator,
    StateExpert as StateExpert,
)
from .disturbance import Disturbance as Disturbance
from .operators import (
    OPERATORS as OPERATORS,
    Operator as Operator,
    Style as Style,
    draw_operator as draw_operator,
)
