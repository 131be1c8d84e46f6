from .control import ControlPeriod as ControlPeriod
