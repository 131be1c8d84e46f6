"""Ctrl-C as in a terminal for every run of the tests; where and how workers start, as parameters of tests."""

import gc
import multiprocessing
import signal

import pytest

from tests import forked  # noqa: F401  says what the server of `forked_workers` imports
from torchrl_sparse.runtime.backends import backend_runtime


@pytest.fixture(scope="session", autouse=True)
def ctrl_c_interrupts():
    """A shell hands SIGINT on ignored to what it starts in the background, and Python keeps it so."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """What runs on Ray waits for the tier that installs it."""
    for item in items:
        parameters = item.callspec.params.values() if hasattr(item, "callspec") else ()
        if "ray_cluster" in item.fixturenames or "ray" in map(str, parameters):
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

    By default they are spawned, and each then imports PyTorch and TorchRL anew, five seconds of a core.
    """
    before = multiprocessing.get_start_method(allow_none=True)
    multiprocessing.set_start_method("forkserver", force=True)
    yield
    multiprocessing.set_start_method(before, force=True)
