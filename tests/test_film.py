"""Films add up exactly in any order and grouping; rounds are cut so that every tile of every pass is traced once."""

import itertools

import numpy as np
import pytest

from causticmpi.render.film import BLOCK, CHANNELS, HIGH, LOW, Film, quantum_for, resolve
from causticmpi.render.rounds import FINENESS, LEAST, Batches, Share, divide, equal_round

SLOTS, PASSES = 40, 64
QUANTUM = quantum_for(15.0)


def passes(seed: int = 1, count: int = PASSES) -> np.ndarray:
    """Pass films (count, SLOTS, 6) with values over eight decades below 16, many of them 0."""
    generator = np.random.default_rng(seed)
    values = 16 * 10 ** generator.uniform(-8, 0, size=(count, SLOTS, 6))
    return np.where(generator.random(values.shape) < 0.2, 0, values).astype(np.float32)


def add_up(films: np.ndarray) -> Film:
    film = Film(SLOTS, QUANTUM)
    for one in films:
        film.add_pass(one.copy())
        film.passes += 1
    return film


@pytest.mark.parametrize("seed", range(5))
def test_any_order_and_grouping_gives_the_same_bits(seed: int) -> None:
    films = passes()
    generator = np.random.default_rng(seed)
    whole = add_up(films)
    order = generator.permutation(PASSES)
    assert np.array_equal(add_up(films[order]).sums, whole.sums)
    cuts = np.sort(generator.choice(np.arange(1, PASSES), 5, replace=False))
    groups = [add_up(group) for group in np.split(films[order], cuts)]
    while len(groups) > 1:  # merged as a random tree, each way round
        a = groups.pop(generator.integers(len(groups)))
        b = groups.pop(generator.integers(len(groups)))
        a.merge(b)
        groups.append(a)
    assert np.array_equal(groups[0].sums, whole.sums) and groups[0].passes == PASSES


def test_ranks_that_share_a_pass() -> None:
    """Slots split over ranks: each adds its own part of the pass, the rest black."""
    films = passes()
    whole, parts = add_up(films), [Film(SLOTS, QUANTUM) for _ in range(3)]
    for one, (rank, part) in itertools.product(films, enumerate(parts)):
        own = np.zeros_like(one)
        own[rank::3] = one[rank::3]
        part.add_pass(own)
    parts[0].merge(parts[1])
    parts[0].merge(parts[2])
    assert np.array_equal(parts[0].sums, whole.sums)


def test_exact_up_to_the_stated_limit() -> None:
    """2^53 quanta: 2^17 passes at the full brightness of the light itself still add up without rounding."""
    quantum = quantum_for(1.0)
    bright = np.full((1, 6), 8.0, np.float32)
    odd = np.full((1, 6), np.float32(quantum), np.float32)
    film = Film(1, quantum)
    for _ in range(8000):
        film.add_pass(bright.copy())
    film.add_pass(odd.copy())
    other = Film(1, quantum)
    other.add_pass(odd.copy())
    for _ in range(8000):
        other.add_pass(bright.copy())
    assert (film.sums[0, :6] == 64000 + quantum).all() and np.array_equal(film.sums, other.sums)
    assert (film.sums[0, 6:9] + film.sums[0, 9:] == 8000 * 256).all()


def test_squares_of_long_runs_are_exact() -> None:
    """Both parts of the squares after 93,312 passes of a bright pixel, against whole numbers of any size."""
    quantum = quantum_for(1.0)
    film = Film(1, quantum)
    for value in np.random.default_rng(2).random((128, 1, 6)).astype(np.float32) / 2:
        film.add_pass(value)
    steps = quantum**2 * np.repeat([HIGH, LOW], 3)
    expected = [3**6 * int(count) for count in film.sums[0, 6:] / steps]
    for _ in range(6):
        once = Film(1, quantum)
        once.merge(film)
        film.merge(once)
        film.merge(once)
    assert [int(count) for count in film.sums[0, 6:] / steps] == expected


def test_squares_of_fireflies_are_exact() -> None:
    """One firefly of a hundred times the light's radiance, among dim passes, in any grouping."""
    random = np.random.default_rng(8)
    values = (random.random((200, 1, 6)) * 1e-3).astype(np.float32)
    values[17] = 700.0
    quantum = quantum_for(15.0)
    whole, reverse = Film(1, quantum), Film(1, quantum)
    for value in values:
        whole.add_pass(value.copy())
    for value in values[::-1]:
        reverse.add_pass(value.copy())
    assert np.array_equal(whole.sums, reverse.sums)
    squares = (values[:, 0, :3].astype(np.float64) + values[:, 0, 3:]) ** 2
    np.testing.assert_allclose(whole.sums[0, 6:9] + whole.sums[0, 9:], squares.sum(axis=0), rtol=1e-12)


def test_sums_against_numpy() -> None:
    films = passes()
    film = add_up(films)
    wide = films.astype(np.float64)
    squares = ((wide[..., :3] + wide[..., 3:]) ** 2).sum(axis=0)
    # Each value is off by half a quantum at most.
    np.testing.assert_allclose(film.sums[:, :6], wide.sum(axis=0), rtol=0, atol=PASSES * QUANTUM / 2)
    found = film.sums[:, 6:9] + film.sums[:, 9:]
    np.testing.assert_allclose(found, squares, rtol=1e-12, atol=PASSES * QUANTUM**2 * LOW)
    assert film.sums.shape == (SLOTS, CHANNELS) and film.sums.dtype == np.float64
    np.testing.assert_allclose(film.sums[:, :6], np.rint(film.sums[:, :6] / QUANTUM) * QUANTUM, rtol=0, atol=0)


def test_resolve_against_numpy() -> None:
    films = passes(2).astype(np.float64)
    diffusive, caustic, variance = resolve(add_up(films.astype(np.float32)).sums, PASSES)
    np.testing.assert_allclose(diffusive, films[..., :3].mean(axis=0), atol=QUANTUM)
    np.testing.assert_allclose(caustic, films[..., 3:].mean(axis=0), atol=QUANTUM)
    oracle = (films[..., :3] + films[..., 3:]).var(axis=0, ddof=1) / PASSES
    np.testing.assert_allclose(variance, oracle, rtol=1e-6, atol=1e-12)


def test_resolve_of_a_single_pass_and_of_equal_passes() -> None:
    one = passes(3, 1)
    assert not resolve(add_up(one).sums, 1)[2].any()
    variance = resolve(add_up(np.repeat(one, 50, axis=0)).sums, 50)[2]
    assert (variance >= 0).all() and variance.max() < 1e-9


def test_variance_of_the_mean_is_covered() -> None:
    """The mean of normal-like pixels lies within its stated error as often as it should (fixed seed, 4 sigma)."""
    generator = np.random.default_rng(9)
    films = generator.gamma(4.0, 0.25, size=(256, 2000, 6)).astype(np.float32)
    film = Film(2000, quantum_for(4.0))
    for one in films:
        film.add_pass(one.copy())
    diffusive, caustic, variance = resolve(film.sums, 256)
    z = (diffusive + caustic - 2) / np.sqrt(variance)
    assert abs((np.abs(z) < 1).mean() - 0.6827) < 4 * np.sqrt(0.6827 * 0.3173 / z.size)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 3.3e38])
@pytest.mark.parametrize("channel", range(6))
def test_non_finite_samples_are_counted_and_black(bad: float, channel: int) -> None:
    films = passes(4, 3)
    spoilt = films.copy()
    spoilt[1, 5, channel] = bad
    films[1, 5] = 0
    film = add_up(spoilt)
    assert film.nonfinite == 1 and np.array_equal(film.sums, add_up(films).sums)


def test_add_pass_blanks_the_pass_film_and_clear_the_film() -> None:
    one = passes(5, 1)[0]
    one[3, 2] = np.nan
    film = Film(SLOTS, QUANTUM)
    film.add_pass(one)
    assert not one.any() and film.passes == 0 and film.nonfinite == 1 and film.sums.any()
    film.passes, film.rays = 3, 7
    other = Film(SLOTS, QUANTUM)
    other.merge(film)
    other.merge(film)
    assert (other.passes, other.rays, other.nonfinite) == (6, 14, 2)
    film.clear()
    assert (film.passes, film.rays, film.nonfinite) == (0, 0, 0) and not film.sums.any()


def test_parts_of_passes_are_merged_and_forgotten_like_wholes() -> None:
    slots = 5 * BLOCK + 7
    whole, part, total = Film(slots, QUANTUM), Film(slots, QUANTUM), Film(slots, QUANTUM)
    for start, stop in ((5, 9), (BLOCK - 1, BLOCK + 1), (slots - 3, slots), (7, 20), (3 * BLOCK, 4 * BLOCK)):
        one = np.zeros((slots, 6), np.float32)
        one[start:stop] = 0.1 * start + np.arange(6)
        whole.add_pass(one.copy())
        part.add_pass(one, slice(start, stop))
        assert not one.any()
    assert np.array_equal(part.sums, whole.sums) and part.touched.tolist() == [True, True, False, True, False, True]
    total.merge(part)
    total.merge(Film(slots, QUANTUM))
    assert np.array_equal(total.sums, whole.sums) and np.array_equal(total.touched, part.touched)
    part.clear()
    assert not part.sums.any() and not part.touched.any()


@pytest.mark.parametrize("brightest", [1e-6, 0.7, 1.0, 15.0, 16.0, 1e9])
def test_quantum(brightest: float) -> None:
    """A power of two, between 2^-36 and 2^-35 of the brightest light."""
    quantum = quantum_for(brightest)
    assert np.frexp(quantum)[0] == 0.5 and 2.0**-36 <= quantum / brightest < 2.0**-35


@pytest.mark.parametrize("size", [1, 2, 3, 4, 7, 16, 61])
def test_shares_cover_every_tile_once(size: int) -> None:
    for count, tiles, first in itertools.product((1, 2, 3, 4, 7, 16, 32), (1, 2, 5, 60, 61, 400), (0, 13)):
        seen = np.zeros((count, 16 * tiles), int)
        left = count * tiles
        for share in divide(first, count, tiles, size):
            assert share.first % 16 == 0 and share.first < share.last <= 16 * tiles
            seen[share.pass_index - first, share.first : share.last] += 1
            taken = (share.last - share.first) // 16
            # Small beside what is left, so that no rank holds the others up at the end; one rank cuts nothing.
            assert taken == tiles if size == 1 else taken <= max(np.ceil((left + tiles) / (FINENESS * size)), 2 * LEAST)
            left -= taken
        assert (seen == 1).all()
    assert [s.last for s in divide(0, 40, 100, 2)[:25]] == [1600] * 25  # whole passes while there are plenty


class Crowded:
    """A method whose every call waits a second for others, and whose first ones are dear. `cpu`, `wall`: the clocks."""

    light_paths = 6400

    def __init__(self) -> None:
        self.cpu = self.wall = 0.0
        self.known: set[str] = set()

    def _spend(self, what: str, seconds: float) -> int:
        spent = seconds + (0.0 if what in self.known else 5.0)
        self.known.add(what)
        self.cpu += spent
        self.wall += spent + 1.0
        return 1

    def begin_pass(self, pass_index: int) -> int:
        return self._spend("begin", 0.25)

    def trace(self, pixels: np.ndarray, film: np.ndarray) -> int:
        return self._spend("trace", 1e-5 * len(pixels))

    def trace_light(self, pass_index: int, first: int, last: int, film: np.ndarray) -> int:
        return self._spend("light", 1e-4 * (last - first))


def test_the_pilot_counts_neither_waiting_nor_first_calls(monkeypatch: pytest.MonkeyPatch) -> None:
    method = Crowded()
    monkeypatch.setattr("causticmpi.render.rounds.time.process_time", lambda: method.cpu)
    monkeypatch.setattr("causticmpi.render.rounds.time.perf_counter", lambda: method.wall)
    batches = Batches(method, np.zeros((16 * 4000, 4), np.int32), 4)
    assert batches.pilot_seconds() == pytest.approx(0.25 + 1e-5 * 16 * 4000 + 1e-4 * 6400)
    assert not batches.pass_film.any() and not batches.light_film.any()


class Idle:
    """A method that does nothing but note the rows it was asked for."""

    light_paths = 0

    def __init__(self) -> None:
        self.begun: list[int] = []
        self.rows: list[int] = []

    def begin_pass(self, pass_index: int) -> int:
        self.begun.append(pass_index)
        return 1

    def trace(self, pixels: np.ndarray, film: np.ndarray) -> int:
        self.rows.append(len(pixels))
        return 2


def test_a_thousand_shares_of_one_batch() -> None:
    """Batches grow fourfold where a share takes no time, but not without end; every row is traced."""
    method, film = Idle(), Film(4, QUANTUM)
    batches = Batches(method, np.zeros((64, 4), np.int32), 4)
    assert batches.trace([Share(i, 16, 48) for i in range(1000)], film, lambda: False)
    assert method.begun == list(range(1000)) and method.rows == [32] * 1000 and film.rays == 3000
    assert 16 <= batches.rows <= 64


def test_a_batch_is_followed_by_a_look_at_the_clock() -> None:
    """A share that is stopped is given up at once, and nothing of it stays on the pass film."""
    method, film = Idle(), Film(4, QUANTUM)
    batches = Batches(method, np.zeros((16 * 1024, 4), np.int32), 4)
    batches.pass_film[:] = 1
    assert not batches.trace([Share(0, 0, 16 * 1024), Share(1, 0, 16)], film, lambda: True)
    assert len(method.rows) == 1 and not batches.pass_film.any() and not film.sums.any()


def test_parts_of_one_pass_begin_it_once() -> None:
    method, film = Idle(), Film(4, QUANTUM)
    batches = Batches(method, np.zeros((64, 4), np.int32), 4)
    assert batches.trace([Share(5, 0, 16), Share(5, 32, 48), Share(6, 16, 32)], film, lambda: False)
    assert method.begun == [5, 6] and method.rows == [16, 16, 16] and film.rays == 8


@pytest.mark.parametrize("size", [1, 2, 3, 7, 20])
def test_rounds_take_what_is_aimed_at(size: int) -> None:
    """Rounds of many cheap passes give each rank whole passes and all of the time; of dear passes, part of one."""
    for seconds in (1e-9, 1e-3, 0.01, 0.1, 0.3, 1.0, 30.0, 1e6):
        for aim in (0.05, 1.0):
            passes = equal_round(seconds, aim, size)
            assert passes >= 1 and (passes < size or passes % size == 0)
            if passes > 1:  # never longer than the aim
                assert passes * seconds / size <= aim * (1 + 1e-9)
            if seconds < aim / 4:  # and not much shorter: at most one pass of each rank
                assert (passes / size + 1) * seconds > aim * (1 - 1e-9)
    assert equal_round(0.0, 1.0, size) >= 1


def test_rounds_of_one_and_of_twenty_ranks() -> None:
    assert [equal_round(0.3, 1.0, size) for size in (1, 20)] == [3, 60]
    assert [equal_round(0.125, 1.0, size) for size in (1, 20)] == [8, 160]
    assert [equal_round(4.0, 1.0, size) for size in (1, 20)] == [1, 5]
    assert [equal_round(100.0, 1.0, size) for size in (1, 20)] == [1, 1]
