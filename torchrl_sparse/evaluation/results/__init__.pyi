from .build import (
    MethodRun as MethodRun,
    Terms as Terms,
    build_results as build_results,
)
from .parts import PolicyShape as PolicyShape
from .report import (
    format_table as format_table,
)
from .schema import (
    MethodEntry as MethodEntry,
    Results as Results,
    load_results as load_results,
    save_results as save_results,
)
