from .absolute import convert_demos as convert_demos
from .demos import collect as collect
from .rendering import render_demos as render_demos
from .robomimic import (
    Demonstrations as Demonstrations,
    read_demos as read_demos,
)
