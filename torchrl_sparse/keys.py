"""Every TensorDict key that the library reads or writes: one constant each, one meaning each.

Names that TorchRL's own vision-language-action schema (`torchrl.data.vla`) already has are used as they are. ``*B`` is the
batch of environments (it may be empty), K the denoising steps, L the layers, A the action dimension, To the observation steps.

================================  =====================  ===========================================================
constant                          shape, dtype           meaning
================================  =====================  ===========================================================
``STATE``                         f32 [*B, Ds]           proprioception and, in state tasks, the objects' state
``IMAGE``, ``WRIST_IMAGE``        u8 [*B, 3, h, w]       cameras, only when asked for
``EEF_VEL``                       f32 [*B, 6 per arm]    end-effector twist in the world frame, m/s and rad/s
``INSTRUCTION``                   str                    what to do, in words, only when asked for
``SUCCESS``                       bool [*B, 1]           the task's own predicate
``EPISODE_SEED``                  i64 [*B, 1]            the seed that fixed this episode's initial state
``EPISODE_STEP``                  i64 [*B, 1]            environment steps since the reset
``HISTORY_STATE``                 f32 [*B, To, Ds]       the last To states, oldest first
``history(name)``                 [*B, To, ...]          the last To entries of any observation, e.g. of a camera
``IS_INIT``                       bool [*B, 1]           first step of an episode (TorchRL's ``InitTracker``)
``COND``                          f32 [*B, To, D]        encoded observations that condition the denoiser
``SEED``                          i64 [*B, 1]            seeds all noise of one query, the initial and the per-step noise
``PRUNE_MASK``                    bool [*B, K, 3L]       True = pruned; axis K in execution order; column
                                                         ``3 * layer + {0: SA, 1: CA, 2: FFN}``; row 0 never prunes
``CHUNK``                         f32 [*B, n, A]         actions in environment units; entry 0 is for the present step
``ACTION``                        f32 [*B, A]            the action of this step
``REPLAN``                        bool [*B, 1]           a gate asks for a new query now
``AGE``                           i64 [*B, 1]            position of ``ACTION`` in the chunk; 0 right after a query
``QUERIED``                       bool [*B, 1]           this step called the policy
``FLOPS``                         f32 [*B, 1]            2 * MAC of this query's denoising loop, 0 on served steps
``LATENCY``                       f32 [*B, 1]            seconds of this query, 0 on served steps
================================  =====================  ===========================================================
"""

from tensordict import NestedKey, TensorDictBase
from torch import Tensor

STATE = ("observation", "state")
IMAGE = ("observation", "image")
WRIST_IMAGE = ("observation", "wrist_image")
EEF_VEL = ("observation", "eef_vel")
INSTRUCTION = "language_instruction"
SUCCESS = "success"

EPISODE_SEED = ("episode", "seed")
EPISODE_STEP = ("episode", "step")
HISTORY_STATE = ("history", "state")
IS_INIT = "is_init"

COND = ("diffusion", "cond")
SEED = ("diffusion", "seed")
PRUNE_MASK = ("diffusion", "prune_mask")

CHUNK = ("vla_action", "chunk")
ACTION = "action"

REPLAN = ("control", "replan")
AGE = ("control", "age")
QUERIED = ("control", "queried")

FLOPS = ("cost", "flops")
LATENCY = ("cost", "latency")


def history(name: str) -> tuple[str, str]:
    """Key of the last entries of ``("observation", name)``.

    >>> history("image")
    ('history', 'image')
    """
    return ("history", name)


def read(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """The entry under ``key``.

    Raises:
        KeyError: if there is none; the message names the key and those that are there.
    """
    value = tensordict.get(key, None)
    if value is None:
        there = sorted(map(str, tensordict.keys(include_nested=True, leaves_only=True)))
        raise KeyError(f"expected the key {key!r}, got {', '.join(there) or 'an empty TensorDict'}")
    return value
