from .diffusion import (
    METHODS as METHODS,
    Method as Method,
    MethodInputs as MethodInputs,
    check_method as check_method,
    make_controller as make_controller,
    make_method as make_method,
)
from .spec import MethodSpec as MethodSpec
from .token_budget import (
    BudgetPoint as BudgetPoint,
    TokenBudget as TokenBudget,
)
from .vla import (
    TOKEN_METHODS as TOKEN_METHODS,
    TokenMethod as TokenMethod,
    make_pruner as make_pruner,
)
