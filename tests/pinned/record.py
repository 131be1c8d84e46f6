"""Writes what the pinned tests compare with, from the code as it is: ``python -m tests.pinned.record``.

What is stored already stays as it is, unless it is named: ``python -m tests.pinned.record assets/can`` records Can's again.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from tests.pinned import actions, tables


def load_actions() -> dict[str, dict[str, Tensor]]:
    """case -> its answer."""
    answers: dict[str, dict[str, Tensor]] = {}
    for key, value in load_file(actions.STORED).items():
        case, _, name = key.rpartition("/")
        answers.setdefault(case, {})[name] = value
    return answers


def load_tables() -> dict[str, list[str]]:
    """file -> the lines of its tables."""
    return json.loads(tables.STORED.read_text(encoding="utf-8"))


def packed(answer: dict[str, Tensor]) -> dict[str, Tensor]:
    """An answer as it is stored: eight blocks of a boolean mask are one byte, layers of a token are one byte."""
    mask = answer["mask"].flatten(1).numpy()
    stored = np.packbits(mask, axis=1) if mask.dtype == bool else mask.astype(np.uint8)
    return {**answer, "mask": torch.from_numpy(stored)}


def main(again: set[str]) -> None:
    """Record what is new, and the assets in ``again``; what is no more is dropped."""
    stored = {case: answer for case, answer in load_actions().items() if case.partition("/")[0] not in again}
    answers = {
        name: stored.get(name) or packed(case.answer()) for case in actions.cases() if (name := str(case))
    }
    tensors = {f"{case}/{name}": value for case, answer in answers.items() for name, value in answer.items()}
    save_file({name: value.contiguous() for name, value in tensors.items()}, actions.STORED)
    lines = {name: lines for name, lines in load_tables().items() if name.partition("/")[0] not in again}
    made = {name: lines.get(name) or tables.table(name) for name in tables.names()}
    tables.STORED.write_text(json.dumps(made, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main({Path(argument).name for argument in sys.argv[1:]})
