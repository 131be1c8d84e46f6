"""How tests ask that an input is refused: by its entry, and by what every such message has, never by its wording."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from torchrl_sparse.errors import InputError


@contextmanager
def refused(entry: str, kind: type[Exception] = InputError) -> Iterator[pytest.ExceptionInfo[Exception]]:
    """Expect one line that names ``entry``: an option, an argument or a key, or a file; what leads to it may be left out.

    An error of another ``kind``, such as that of a missing file, has no entry of its own: its message has to name it.
    """
    with pytest.raises(kind) as raised:
        yield raised
    message = str(raised.value)
    assert "\n" not in message
    if not isinstance(raised.value, InputError):
        assert entry in message
        return
    named = raised.value.entry
    assert named.endswith(entry), message
    assert not named.removesuffix(entry)[-1:].isalnum(), message
