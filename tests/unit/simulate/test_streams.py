"""Keyed random numbers: known answers, quantiles, and keys that depend on position alone."""

import numpy as np
import pytest
from scipy import special, stats

from pchem_pipeline.simulate import streams_numba
from pchem_pipeline.simulate.streams import (
    KeyedStreams,
    make_key,
    normal_quantile,
    poisson_quantile,
    uniform_pair,
)

# counter, key and result of philox4x32-10 from the known-answer file of the Random123 library (kat_vectors)
KNOWN_ANSWERS = [
    ("00000000 00000000 00000000 00000000", "00000000 00000000", "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
    ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff", "408f276d 41c83b0e a20bc7c6 6d5451fd"),
    ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
]


def words(text):
    return [np.uint64(int(word, 16)) for word in text.split()]


def streams(frames=(0, 5), rows=(0, 4), columns=6, *, seed=3, purpose="test"):
    return KeyedStreams(seed, purpose, np.arange(*frames), np.arange(*rows), np.arange(columns))


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize(("counter", "key", "answer"), KNOWN_ANSWERS)
def test_philox_gives_the_known_answers(counter, key, answer, compiled):
    function = streams_numba.philox_block if compiled else streams_numba.philox_block.py_func
    assert [int(word) for word in function(*words(counter), *words(key))] == [int(w) for w in words(answer)]


def test_uniforms_are_the_words_of_the_block():
    frames, ys, xs = (np.array([value], dtype=np.uint64) for value in (7, 11, 13))
    key = make_key(5, "purpose")
    first, second = uniform_pair(key, frames, ys, xs, draw=2)
    a, b, c, d = streams_numba.philox_block(*(np.uint64(v) for v in (7, 13, 11, 2)), *key)
    for value, high, low in ((first, a, b), (second, c, d)):
        assert value.item() == (((int(high) << 32 | int(low)) >> 12) + 0.5) / 2**52


def test_normal_quantile_agrees_with_scipy():
    ends = 0.5 * 2.0**-52, 1 - 0.5 * 2.0**-52  # the smallest and the largest of the uniform numbers
    p = np.concatenate([np.linspace(1e-4, 1 - 1e-4, 4001), 10.0 ** -np.arange(1, 300, 7), ends])
    np.testing.assert_allclose(normal_quantile(p), special.ndtri(p), rtol=2e-15, atol=1e-16)


@pytest.mark.parametrize("mean", [0.0, 1e-3, 0.3, 2.0, 17.0, 99.0, 105.0, 744.0, 5e3, 1e6])
def test_poisson_quantile_agrees_with_scipy(mean):
    # the sum of n masses is good to about n / 1e16, the first mass to mean / 1e16
    tail = 1e-12 if mean < 1e3 else 1e-8
    u = np.concatenate([np.random.default_rng(4).random(3000), [tail, 1 - tail]])
    np.testing.assert_array_equal(poisson_quantile(u, np.array(mean)), stats.poisson.ppf(u, mean))


@pytest.mark.parametrize(
    ("dims", "shape"),
    [
        ((), (1, 1, 1)),
        (("frame",), (5, 1, 1)),
        (("y",), (1, 4, 1)),
        (("x",), (1, 1, 6)),
        (("frame", "y"), (5, 4, 1)),
        (("y", "x"), (1, 4, 6)),
        (("frame", "y", "x"), (5, 4, 6)),
    ],
)
def test_dims_say_along_what_the_numbers_differ(dims, shape):
    numbers = streams().uniform(dims)
    assert numbers.shape == shape
    early = streams(frames=(-3, 0)).uniform(dims) if "frame" in dims else []
    assert np.unique(np.append(numbers, early)).size == numbers.size + np.size(early)
    part = streams(frames=(2, 4), rows=(1, 3)).uniform(dims)
    cut = (slice(2, 4) if shape[0] > 1 else slice(None), slice(1, 3) if shape[1] > 1 else slice(None))
    np.testing.assert_array_equal(part, numbers[cut])


def test_other_purposes_seeds_draws_and_dims_give_other_numbers_and_their_order_does_not():
    every = ("frame", "y", "x")
    sets = [each.uniform(every) for each in (streams(), streams(purpose="other"), streams(seed=4))]
    sets += [streams().uniform(every, draw=1), special.ndtr(streams().normal(every))]
    sets += [streams().uniform(dims) for dims in (("frame", "y"), ("y", "x"))]
    numbers = np.concatenate([s.ravel() for s in sets])
    assert np.unique(numbers).size == numbers.size
    np.testing.assert_array_equal(streams().normal(("y", "frame")), streams().normal(("frame", "y")))
    with pytest.raises(ValueError, match="column"):
        streams().uniform(("column",))


def test_poisson_numbers_follow_the_mean_given_and_the_position():
    mean = np.full((5, 4, 6), 3.0)
    whole = streams().poisson(mean)
    part = streams(frames=(1, 4)).poisson(mean[1:4])
    np.testing.assert_array_equal(part, whole[1:4])
    assert (streams().poisson(0 * mean) == 0).all()


def test_generators_depend_on_what_they_are_for_alone():
    def first(source, **where):
        return float(source.generator(**where).random())

    names = (), ("frame",), ("y",), ("x",), ("y", "x"), ("frame", "y", "x"), ("draw",)
    places = [dict.fromkeys(each, 1) for each in names]
    values = [first(streams(), **place) for place in places]
    assert len(set(values)) == len(values)
    assert values == [first(streams(frames=(3, 4), rows=(2, 3)), **place) for place in places]
    assert first(streams(seed=9)) != values[0]
