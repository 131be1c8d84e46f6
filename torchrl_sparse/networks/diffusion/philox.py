"""Noise that C++ and Python draw identically, to the last bit: a counter-based generator and plain arithmetic.

The i-th number of a seed is ``Phi^-1((w + 1/2) / 2^32)`` in f64, rounded to f32, where w is word ``i mod 4`` of Philox-4x32
with ten rounds (Salmon et al., SC 2011) under the counter ``i div 4`` and the seed as the key, lower half first. Phi^-1 is
Wichura's AS 241 (Applied Statistics 37, 1988), exact to 1e-16; below 0.075 it needs a logarithm, which a series of
``(x - 1) / (x + 1)`` gives. Nothing but additions, products, quotients and square roots in a fixed order is used, each of
them rounded as IEEE 754 says: no mathematical library, compiler or instruction set makes a difference. ``philox.h`` is the
same in C++.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["philox_noise", "philox_words"]

_WORD = 2**32 - 1
_MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)
_KEY_STEPS = (0x9E3779B9, 0xBB67AE85)
_ROUNDS = 10

# Numerator and denominator, highest power first: near 1/2, of (0.425^2 - (p - 1/2)^2); in the tails, of (sqrt(-ln p) - 1.6).
_MIDDLE = (
    (2.5090809287301226727e3, 3.3430575583588128105e4, 6.7265770927008700853e4, 4.5921953931549871457e4,
     1.3731693765509461125e4, 1.9715909503065514427e3, 1.3314166789178437745e2, 3.3871328727963666080e0),
    (5.2264952788528545610e3, 2.8729085735721942674e4, 3.9307895800092710610e4, 2.1213794301586595867e4,
     5.3941960214247511077e3, 6.8718700749205790830e2, 4.2313330701600911252e1, 1.0),
)  # fmt: skip
_TAIL = (
    (7.74545014278341407640e-4, 2.27238449892691845833e-2, 2.41780725177450611770e-1, 1.27045825245236838258e0,
     3.64784832476320460504e0, 5.76949722146069140550e0, 4.63033784615654529590e0, 1.42343711074968357734e0),
    (1.05075007164441684324e-9, 5.47593808499534494600e-4, 1.51986665636164571966e-2, 1.48103976427480074590e-1,
     6.89767334985100004550e-1, 1.67638483018380384940e0, 2.05319162663775882187e0, 1.0),
)  # fmt: skip
_SPLIT, _SPLIT_SQUARED, _TAIL_FROM = 0.425, 0.180625, 1.6
_LN2, _SQRT_HALF, _LOG_TERMS = 0.6931471805599453, 0.7071067811865476, 10


def philox_noise(seed: Tensor, num_steps: int, chunk_shape: tuple[int, int]) -> Tensor:
    """Draw the noise of B policy calls, f32 [B, num_steps, H, A]: entry k of a seed does not depend on ``num_steps``.

    Args:
        seed: i64 [B].
        num_steps: denoising steps K.
        chunk_shape: (H, A).

    Examples:
        >>> philox_noise(torch.tensor([7]), 2, (1, 3))[0, :, 0]
        tensor([[ 1.6912,  0.6750, -1.2046],
                [-1.3680, -0.2354,  0.8249]])
    """
    count = num_steps * chunk_shape[0] * chunk_shape[1]
    counters = torch.arange(-(-count // 4), device=seed.device)
    words = philox_words(seed.long()[:, None], counters).flatten(1)[:, :count]
    normal = _normal_quantile((words.double() + 0.5) * 2.0**-32)
    return normal.float().view(len(seed), num_steps, *chunk_shape)


def philox_words(key: Tensor, counter: Tensor) -> Tensor:
    """Return four words i64 [*shape, 4] in [0, 2^32), for keys and counters i64 that broadcast to ``shape``.

    >>> [hex(word) for word in philox_words(torch.tensor(0), torch.tensor(0)).tolist()]
    ['0x6627e8d5', '0xe169c58d', '0xbc57ac4c', '0x9b00dbd8']
    """
    key, counter = torch.broadcast_tensors(key, counter)
    words = [counter & _WORD, counter >> 32 & _WORD, torch.zeros_like(counter), torch.zeros_like(counter)]
    keys = [key & _WORD, key >> 32 & _WORD]
    for _ in range(_ROUNDS):
        # i64 products keep the lower 64 bits, as unsigned ones do.
        first, second = words[0] * _MULTIPLIERS[0], words[2] * _MULTIPLIERS[1]
        words = [
            (second >> 32 & _WORD) ^ words[1] ^ keys[0],
            second & _WORD,
            (first >> 32 & _WORD) ^ words[3] ^ keys[1],
            first & _WORD,
        ]
        keys = [(part + step) & _WORD for part, step in zip(keys, _KEY_STEPS, strict=True)]
    return torch.stack(words, dim=-1)


def _normal_quantile(p: Tensor) -> Tensor:
    """Return Phi^-1 of f64 in [2^-33, 1 - 2^-33]."""
    q = p - 0.5
    near = _SPLIT_SQUARED - q * q
    middle = q * _polynomial(_MIDDLE[0], near) / _polynomial(_MIDDLE[1], near)
    far = (-_logarithm(torch.minimum(p, 1 - p))).sqrt() - _TAIL_FROM
    tail = _polynomial(_TAIL[0], far) / _polynomial(_TAIL[1], far)
    return torch.where(q.abs() <= _SPLIT, middle, torch.where(q < 0, -tail, tail))


def _polynomial(coefficients: tuple[float, ...], x: Tensor) -> Tensor:
    total = torch.full_like(x, coefficients[0])
    for coefficient in coefficients[1:]:
        total = total * x
        total = total + coefficient
    return total


def _logarithm(x: Tensor) -> Tensor:
    """Return ln x of f64 in (0, 1]."""
    mantissa, exponent = torch.frexp(x)
    small = mantissa < _SQRT_HALF
    mantissa = torch.where(small, mantissa * 2, mantissa)
    exponent = (exponent - small.int()).double()
    s = (mantissa - 1) / (mantissa + 1)
    square = s * s
    series = _polynomial(tuple(1 / (2 * term + 1) for term in reversed(range(_LOG_TERMS))), square)
    return exponent * _LN2 + 2 * s * series
