"""The runs of a class of tests are made once."""

import pytest

from tests.options.harness import Runs


@pytest.fixture(scope="class")
def runs(request, tmp_path_factory):
    return Runs(request.cls, lambda: tmp_path_factory.mktemp("run"))
