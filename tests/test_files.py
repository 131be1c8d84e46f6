"""Files stay short enough to be read in one go."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = {"torchrl_sparse": 300, "tests": 300, "recipes": 120}


@pytest.mark.parametrize(("folder", "most"), FOLDERS.items())
def test_no_python_file_is_longer(folder, most):
    lengths = {path: len(path.read_text().splitlines()) for path in (ROOT / folder).rglob("*.py")}
    assert lengths
    assert {str(path.relative_to(ROOT)): lines for path, lines in lengths.items() if lines > most} == {}
