"""Intervals, differences and standard deviations against values that are known or worked out by hand."""

import numpy as np
import pytest
from eval_files import chain_line

from lerobot_lansar.calvin import TASKS
from lerobot_lansar.report.episodes import Episode
from lerobot_lansar.report.figures import bootstrap, difference, figures, standard_deviation, wilson
from lerobot_lansar.report.published import PUBLISHED


def episodes(*lengths, first=0):
    """Chains with so many commands fulfilled."""
    rows = [chain_line(first + k, length) for k, length in enumerate(lengths)]
    return [Episode(commands, seed, chain) for seed, chain, commands in rows]


@pytest.mark.parametrize(
    ("successes", "attempts", "interval"),
    [
        # z = 1.959964: (p + z²/2n ± z √(p(1-p)/n + z²/4n²)) / (1 + z²/n)
        (8, 10, [0.4902, 0.9433]),
        (0, 10, [0.0, 0.2775]),
        (10, 10, [0.7225, 1.0]),
        (697, 1000, [0.6678, 0.7247]),  # Table 5.1, one in a row
        (1, 1, [0.2065, 1.0]),
    ],
)
def test_shares_have_wilsons_interval(successes, attempts, interval):
    assert wilson(successes, attempts) == pytest.approx(interval, abs=1e-4)


def test_the_bootstrap_agrees_with_the_normal_interval_on_many_chains():
    lengths = np.arange(1000) % 6
    half = 1.96 * lengths.std() / np.sqrt(1000)
    (interval,) = bootstrap([lengths])
    assert interval == pytest.approx([lengths.mean() - half, lengths.mean() + half], abs=0.01)
    assert bootstrap([lengths]) == [interval], "the same draws every time"


def test_where_chains_do_not_differ_the_bootstrap_says_nothing():
    assert bootstrap([[3]]) == [None]
    assert bootstrap([[3, 3, 3], [0, 1, 2]])[0] is None
    assert bootstrap([[3, 3, 3], [0, 1, 2]])[1] == [0, 2]


def test_figures_of_five_chains():
    found = figures(episodes(5, 3, 0, 1, 1))
    assert found["in_a_row"] == [0.8, 0.4, 0.4, 0.2, 0.2]
    assert found["average_length"] == pytest.approx(2)
    assert found["local_success_rate"] == 10 / 14  # four chains failed a command
    assert found["local_success_rate_interval"] == pytest.approx(wilson(10, 14))
    assert found["in_a_row_intervals"][0] == pytest.approx(wilson(4, 5))


def test_differences_are_taken_chain_by_chain():
    one, other = episodes(5, 3, 0, 1), episodes(4, 1, 1, 5, first=1)  # chains 0-3 and 1-4
    found = difference(one, other)
    assert found["chains"] == 3
    assert found["average_length"] == pytest.approx(((3 - 4) + (0 - 1) + (1 - 1)) / 3)
    assert found["in_a_row"] == pytest.approx([-1 / 3, 0, 0, -1 / 3, 0])
    assert found["average_length_interval"] == [-1, 0]
    assert found["in_a_row_intervals"][1] is None, "no chain differs"


def test_a_paired_difference_is_surer_than_two_intervals():
    rng = np.random.default_rng(0)
    lengths = rng.integers(0, 5, 300)
    better = np.minimum(lengths + (rng.random(300) < 0.3), 5)
    low, high = difference(episodes(*better), episodes(*lengths))["average_length_interval"]
    one = figures(episodes(*better))["average_length_interval"]
    assert 0 < low < high
    assert high - low < 0.5 * (one[1] - one[0])


def test_chains_that_were_not_both_played_once_are_not_paired():
    assert difference(episodes(1, 2), episodes(3, first=7)) is None
    assert difference(episodes(1, 2), episodes(3) + episodes(4)) is None
    assert difference([Episode([("open_drawer", True)], 0, None)], episodes(1)) is None


def test_standard_deviations_are_the_thesis_own():
    rows = [row.in_a_row for row in PUBLISHED["thesis_5.4"].rows]
    percent = [round(100 * value, 4) for value in standard_deviation(rows)]
    assert percent == [0.4657, 0.7089, 0.9341, 0.6534, 0.7790]  # Table 5.4


def test_the_published_task_counts_add_up_to_the_published_total():
    tasks = PUBLISHED["thesis_5.1"].rows[0].tasks
    assert tasks.keys() == TASKS.keys()
    assert [sum(column) for column in zip(*tasks.values(), strict=True)] == [1697, 2604]  # Table 5.2


def test_published_success_never_rises_along_a_chain():
    for table in PUBLISHED.values():
        for row in table.rows:
            assert len(row.in_a_row) == 5
            assert list(row.in_a_row) == sorted(row.in_a_row, reverse=True)
