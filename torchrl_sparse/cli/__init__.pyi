from .options import (
    check_names as check_names,
    check_options as check_options,
)
from .recipe import recipe as recipe
