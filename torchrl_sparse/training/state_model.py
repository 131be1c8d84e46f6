"""Fit of the linear state model to demonstrations."""

from __future__ import annotations

from torchrl_sparse import keys
from torchrl_sparse.control.roll_forward import StateModel
from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.errors import InputError

__all__ = ["fit_state_model"]


def fit_state_model(demos: Demonstrations, steps: int) -> tuple[StateModel, float]:
    """Fit a one-step model to demonstrations and test it on held-out ones.

    Args:
        demos: two episodes or more, with states; the last tenth, one at least, is held out.
        steps: how far ahead it is tried.

    Returns:
        The model, and its error beside that of a state that is not rolled forward: each relative to how much its number varies,
        mean over the numbers, the model's over the other's.

    Raises:
        InputError: for fewer episodes, or if they are too short.
    """
    if len(demos) < 2:
        raise InputError(f"demos: expected 2 demonstrations or more, got {len(demos)}")
    episodes = [
        (rows.get(keys.STATE), rows.get(keys.ACTION)) for rows in map(demos.episode, range(len(demos)))
    ]
    held_out = max(1, len(episodes) // 10)
    model = StateModel.fit(episodes[:-held_out])
    rolled, stale = model.errors(episodes[-held_out:], steps)
    varies = (deviation := demos.data.get(keys.STATE).std(dim=0)) > 0
    share = (rolled / deviation)[varies].mean() / (stale / deviation)[varies].mean()
    return model, share.item()
