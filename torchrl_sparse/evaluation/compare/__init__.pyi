from .export import write_episodes as write_episodes, write_lerobot as write_lerobot
from .files import read_methods as read_methods
from .outcomes import MethodOutcomes as MethodOutcomes, Outcome as Outcome
from .verdicts import Comparison as Comparison, compare_methods as compare_methods
