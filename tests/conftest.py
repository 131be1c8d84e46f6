"""Ctrl-C as in a terminal for every run of the tests; where and how workers start, as parameters of tests."""

import gc
import multiprocessing
import signal
from pathlib import Path

import pytest

from tests import forked  # noqa: F401  says what the server of `forked_workers` imports
from torchrl_sparse.runtime.backends import backend_runtime


@pytest.fixture(scope="session", autouse=True)
def ctrl_c_interrupts():
    """A shell hands SIGINT on ignored to what it starts in the background, and Python keeps it so."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


FULL = (
    "pinned", "torture", "peers", "studies", "envs", "training", "data", "options",
    "evaluation/accelerate", "evaluation/benchmarks", "evaluation/figures", "evaluation/rollouts",
    "cli/test_sweep_recipe.py", "evaluation/results/test_engine_report.py",
    "evaluation/statistics/test_sequential.py", "cli/test_recipe.py", "control/test_matrix.py",
    "policies/diffusion/test_export.py", "policies/vla/test_trained.py", "storage/published",
    "storage/test_exhaustion.py", "tokens/test_closed_loop.py", "valid_inputs/test_demonstrations.py",
    "valid_inputs/test_sweeps.py", "test_assets.py", "test_checkpoint_recipes.py", "test_examples.py",
    "test_import.py", "test_package.py", "test_pages.py", "test_recipes.py", "test_site.py",
)  # fmt: skip
"""Below `tests`, what the quick tier leaves out: nearly all time of the suite."""
QUICK = (
    "options/test_benchmark.py",
    "options/test_train_policy.py",
    "envs/test_period.py",
)  # two recipes, and steps


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark what the quick tier leaves out, and what runs on Ray, which it does not install."""
    tests = Path(__file__).parent
    left_out, kept = ([tests / name for name in names] for names in (FULL, QUICK))
    for item in items:
        parameters = item.callspec.params.values() if hasattr(item, "callspec") else ()
        on_ray = "ray_cluster" in getattr(item, "fixturenames", ()) or "ray" in map(str, parameters)
        places = {item.path, *item.path.parents}
        if on_ray or (places.intersection(left_out) and not places.intersection(kept)):
            item.add_marker(pytest.mark.full)


def pytest_collection_finish():
    """Robosuite collects garbage whenever a simulator closes, 0.4 s each time if all that was imported is looked through."""
    gc.freeze()


@pytest.fixture(scope="session")
def ray_cluster():
    """A Ray of two CPUs, one for all tests of a process; skips where Ray is not installed."""
    pytest.importorskip("ray")
    with backend_runtime("ray", workers=2):
        yield


@pytest.fixture(params=["process", "ray"])
def backend(request):
    """Both backends, the second where Ray is installed."""
    if request.param == "ray":
        request.getfixturevalue("ray_cluster")
    return request.param


@pytest.fixture
def forked_workers():
    """TorchRL's worker processes as copies of one that has imported everything, where a test is of what they do once they run.

    By default they are spawned, and each then imports PyTorch and TorchRL again, five seconds of a core.
    """
    before = multiprocessing.get_start_method(allow_none=True)
    multiprocessing.set_start_method("forkserver", force=True)
    yield
    multiprocessing.set_start_method(before, force=True)
