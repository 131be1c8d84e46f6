"""Counter-based noise: the published words, the normal distribution, and what pairing asks of it."""

import torch
from scipy.special import ndtri

from torchrl_sparse.networks.diffusion.philox import _normal_quantile, philox_noise, philox_words


def test_the_words_are_those_of_its_authors():
    """Random123's known answers; the upper half of the counter is always 0 here, so the second one takes the rounds apart."""
    assert philox_words(torch.tensor(0), torch.tensor(0)).tolist() == [
        0x6627E8D5,
        0xE169C58D,
        0xBC57AC4C,
        0x9B00DBD8,
    ]
    expected = scalar_philox(0x0123456789ABCDEF, 0x00000012_F0000001)
    assert philox_words(torch.tensor(0x0123456789ABCDEF), torch.tensor(0x12_F0000001)).tolist() == expected


def scalar_philox(key, counter):
    word = 2**32 - 1
    c, k = [counter & word, counter >> 32, 0, 0], [key & word, key >> 32]
    for _ in range(10):
        a, b = c[0] * 0xD2511F53, c[2] * 0xCD9E8D57
        c = [b >> 32 ^ c[1] ^ k[0], b & word, a >> 32 ^ c[3] ^ k[1], a & word]
        k = [k[0] + 0x9E3779B9 & word, k[1] + 0xBB67AE85 & word]
    return c


def test_the_quantile_is_that_of_the_normal_distribution():
    halves = 0.5 ** torch.arange(1, 34, dtype=torch.float64)
    p = torch.cat([torch.arange(1, 100_000).double() / 100_000, halves, 1 - halves])
    assert (_normal_quantile(p) - torch.from_numpy(ndtri(p.numpy()))).abs().max() < 1e-14


def test_moments():
    noise = philox_noise(torch.arange(400), 25, (10, 10)).double()
    assert abs(noise.mean()) < 0.005
    assert abs(noise.var() - 1) < 0.01
    assert abs((noise**4).mean() - 3) < 0.05
    flat = noise.flatten(1)
    assert abs((flat[:, 1:] * flat[:, :-1]).mean()) < 0.005  # neighbours
    assert abs((flat[1:] * flat[:-1]).mean()) < 0.005  # seeds


def test_a_short_chain_begins_as_a_long_one_and_rows_stand_alone():
    seeds = torch.tensor([3, 2**62 + 1, 0])
    long = philox_noise(seeds, 9, (3, 7))
    assert torch.equal(philox_noise(seeds, 2, (3, 7)), long[:, :2])
    assert torch.equal(philox_noise(seeds[1:2], 9, (3, 7)), long[1:2])
