import pytest

pytest.register_assert_rewrite("tests.options.harness")
