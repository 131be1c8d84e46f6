from .pages import write_pages as write_pages
from .report import (
    MethodRun as MethodRun,
    build_results as build_results,
    format_pairs as format_pairs,
    format_table as format_table,
)
from .schema import (
    MethodEntry as MethodEntry,
    PolicyShape as PolicyShape,
    Results as Results,
    load_results as load_results,
    save_results as save_results,
)
