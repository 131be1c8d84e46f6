"""Files stay short enough to be read in one go."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FILES = {
    "torchrl_sparse/**/*.py": 300,
    "tests/**/*.py": 300,
    "recipes/*.py": 120,
    "recipes/studies/**/*.py": 300,
}


@pytest.mark.parametrize(("files", "most"), FILES.items())
def test_no_python_file_is_longer(files, most):
    lengths = {path: len(path.read_text().splitlines()) for path in ROOT.glob(files)}
    assert lengths
    assert {str(path.relative_to(ROOT)): lines for path, lines in lengths.items() if lines > most} == {}
