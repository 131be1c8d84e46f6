from .report import (
    MethodRun as MethodRun,
    build_results as build_results,
    format_pairs as format_pairs,
    format_table as format_table,
    load_results as load_results,
    save_results as save_results,
)
from .schema import validate_results as validate_results
