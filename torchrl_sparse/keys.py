"""Every TensorDict key that the library reads or writes: one constant and one meaning each.

Names that TorchRL's own vision-language-action schema (`torchrl.data.vla`) already has are used as they are. ``*B`` is the
batch of environments (it may be empty), K the denoising steps, L the layers, A the action dimension, To the observation steps,
N the visual tokens.

What a step leaves to the next in keys, a `ChunkExecutor` declares to the environment: by ``make_tensordict_primer``, which
collectors append with ``auto_register_policy_transforms=True``. For TorchRL's `ParallelEnv` hands back the keys of its spec
alone. Others that an actor writes may be dropped; they are then 0 until the next policy call.

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
``EPISODE_COMPLETED``             i64 [*B, 1]            parts of the task done so far, where a benchmark counts them
``EPISODE_WAY``                   i64 [*B, 1]            which of its ways the task is being done, where an environment tells;
                                                         -1 until that shows, -2 if it failed by going between them
``HISTORY_STATE``                 f32 [*B, To, Ds]       the last To states, oldest first
``history(name)``                 [*B, To, ...]          the last To entries of any observation, e.g. of a camera
``IS_INIT``                       bool [*B, 1]           first step of an episode (TorchRL's ``InitTracker``)
``COND``                          f32 [*B, To, D]        encoded observations that condition the denoiser
``FRAME_FEATURES``                f32 [*B, To, F]        features of the cameras' frames, the first columns of ``COND``
``SEED``                          i64 [*B, 1]            seeds all noise of one call, the initial and the per-step noise
``PRUNE_MASK``                    bool [*B, K, 3L]       True = pruned; axis K in execution order; column
                                                         ``3 * layer + {0: SA, 1: CA, 2: FFN}``; row 0 never prunes.
                                                         Without cross-attention 2L, {0: SA, 1: FFN}
``PRUNE_RATE``                    f32 [*B, 1]            prune rate that a rate-conditioned pruner is asked for
``START``                         f32 [*B, H, A]         normalised actions that a call begins from, if not from noise
``NUM_STEPS``                     i64 [*B, 1]            denoising steps that a call takes, the sampler's last; K from noise
``KNOWN``                         f32 [*B, H, A]         normalised actions that a call is guided toward in every step
``PULL``                          f32 [*B, H, 1]         how far, for each of them: 0 is not at all, 1 all the way
``KEEP_MASK``                     bool [*B, N]           True = kept; the N visual tokens, camera by camera; others always stay
``TOKEN_DEPTH``                   i64 [*B, N]            decoder layers that ran on a visual token; 0 was pruned before
                                                         the decoder, L (all of them) was never pruned
``KEPT``                          f32 [*B, 1]            visual tokens in a decoder layer, mean over the layers
``TOKEN_SCORE``                   f32 [*B, N]            importance that a pruner carries to the next call
``TOKEN_FRAMES``                  u8 [*B, V, 3, h, w]    the V cameras' images at the last call, as the network saw them
``TOKEN_PAST_FRAMES``             u8 [*B, R, V, 3, h, w] those of the R calls before it, the latest first, 0 before the
                                                         episode began; where a pruner looks further back
``TOKEN_BUDGET``                  f32 [*B, 1]            visual tokens per camera that the controller grants
``CHUNK``                         f32 [*B, n, A]         actions in environment units; entry 0 is for the present step
``IS_PAD``                        bool [*B, n]           True = the episode ended before that action of a recorded chunk
``ACTION``                        f32 [*B, A]            the action of this step
``REPLAN``                        bool [*B, 1]           a controller asks for a new call now
``FINE``                          bool [*B, 1]           the hand moves slowly and not upwards: a fine-grained action
``CONTROL_STEP``                  i64 [*B, 1]            environment steps that the controller has seen of this episode
``AGE``                           i64 [*B, 1]            position of ``ACTION`` in the chunk; 0 right after a call, -1
                                                         before an episode's first
``UNTIL_QUERY``                   i64 [*B, 1]            steps from the next observation to the next call at the earliest; 0
                                                         where the next observation may be asked about
``QUERIED``                       bool [*B, 1]           this step called the policy
``CANDIDATES``                    f32 [*B, S, n, A]      chunks of a call that was asked S times, of which one is played
``CHOSEN``                        i64 [*B, 1]            which of them
``LAST_CHUNK``                    f32 [*B, n, A]         ``CHUNK`` of the call before, for policies that read it
``ELAPSED``                       i64 [*B, 1]            steps since that call; 0 at the beginning of an episode
``ENSEMBLED``                     i64 [*B, n]            predictions that were averaged into each action of ``CHUNK``
``DELAY``                         i64 [*B, 1]            steps that the latest call takes in a world that does not wait; a
                                                         policy that is asked reads what is expected of its own
``MEANWHILE``                     f32 [*B, n, A]         what is played until then; entry 0 is for the step of the call
``HOLD``                          f32 [*B, A]            the action that keeps the arm where it is
``FLOPS``                         f32 [*B, 1]            2 * MAC of this call's planner and loop, or of a VLA's whole network;
                                                         0 on served steps
``LATENCY``                       f32 [*B, 1]            seconds of this call, 0 on served steps
================================  =====================  ===========================================================
"""

import torch
from tensordict import LazyStackedTensorDict, NestedKey, TensorDictBase
from torch import Tensor

STATE = ("observation", "state")
IMAGE = ("observation", "image")
WRIST_IMAGE = ("observation", "wrist_image")
EEF_VEL = ("observation", "eef_vel")
INSTRUCTION = "language_instruction"
SUCCESS = "success"

EPISODE_SEED = ("episode", "seed")
EPISODE_STEP = ("episode", "step")
EPISODE_COMPLETED = ("episode", "completed")
EPISODE_WAY = ("episode", "way")
HISTORY_STATE = ("history", "state")
IS_INIT = "is_init"

COND = ("diffusion", "cond")
FRAME_FEATURES = ("diffusion", "frame_features")
SEED = ("diffusion", "seed")
PRUNE_MASK = ("diffusion", "prune_mask")
PRUNE_RATE = ("diffusion", "prune_rate")
START = ("diffusion", "start")
NUM_STEPS = ("diffusion", "num_steps")
KNOWN = ("diffusion", "known")
PULL = ("diffusion", "pull")

KEEP_MASK = ("tokens", "keep_mask")
TOKEN_DEPTH = ("tokens", "depth")
KEPT = ("tokens", "kept")
TOKEN_SCORE = ("tokens", "score")
TOKEN_FRAMES = ("tokens", "frames")
TOKEN_PAST_FRAMES = ("tokens", "past_frames")
TOKEN_BUDGET = ("tokens", "budget")

CHUNK = ("vla_action", "chunk")
IS_PAD = "action_is_pad"
ACTION = "action"

REPLAN = ("control", "replan")
FINE = ("control", "fine")
CONTROL_STEP = ("control", "step")
AGE = ("control", "age")
UNTIL_QUERY = ("control", "until_query")
QUERIED = ("control", "queried")
CANDIDATES = ("control", "candidates")
CHOSEN = ("control", "chosen")
LAST_CHUNK = ("control", "last_chunk")
ELAPSED = ("control", "elapsed")
ENSEMBLED = ("control", "ensembled")
DELAY = ("control", "delay")
MEANWHILE = ("control", "meanwhile")
HOLD = ("control", "hold")

FLOPS = ("cost", "flops")
LATENCY = ("cost", "latency")


def history(name: str) -> tuple[str, str]:
    """Return the key of the history of ``("observation", name)``.

    >>> history("image")
    ('history', 'image')
    """
    return ("history", name)


def history_of(key: NestedKey) -> tuple[str, str]:
    """Return the key of an environment observation's history, which has the observation's last name.

    >>> history_of(("robot", "proprio")), history_of("proprio")
    (('history', 'proprio'), ('history', 'proprio'))
    """
    return history(key if isinstance(key, str) else key[-1])


def read(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """Return the entry under ``key``.

    Raises:
        KeyError: if there is none; the message names the key and those that are there.
    """
    value = tensordict.get(key, None)
    if value is None:
        there = sorted(map(str, tensordict.keys(include_nested=True, leaves_only=True)))
        raise KeyError(f"expected the key {key!r}, got {', '.join(there) or 'an empty TensorDict'}")
    return value


def recall(
    tensordict: TensorDictBase,
    key: NestedKey,
    shape: tuple[int, ...],
    fill: float,
    dtype: torch.dtype | None = None,
) -> Tensor:
    """Return the entry carried under ``key`` from an earlier call, [*B, *shape]; ``fill`` for samples without one.

    An asynchronous collector stacks samples at their first step with samples in mid-episode; the stack then lacks the key
    although some of its rows have it. The others get rows of the same shape.

    Args:
        shape, fill, dtype: of a sample's entry where no sample has one; by default the type of ``fill``.
    """
    value = tensordict.get(key, None)
    if value is not None:
        return value
    if isinstance(tensordict, LazyStackedTensorDict):
        known = [value for row in tensordict.tensordicts if (value := row.get(key, None)) is not None]
        if known:
            shape, dtype = known[0].shape[tensordict.ndim - 1 :], known[0].dtype
        rows = [recall(row, key, shape, fill, dtype) for row in tensordict.tensordicts]
        return torch.stack(rows, tensordict.stack_dim)
    return torch.full((*tensordict.batch_size, *shape), fill, dtype=dtype, device=tensordict.device)
