"""Where LeRobot's environment is; what runs there is no test."""

import os
from pathlib import Path

collect_ignore = ["write_policies.py"]

LEROBOT = Path(
    os.environ.get("LEROBOT_PYTHON", Path(__file__).parents[3] / ".venv-lerobot" / "bin" / "python")
)
