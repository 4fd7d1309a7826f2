"""The report reads the frozen chains that the environment runs."""

from lerobot_lansar.report import results


def test_the_frozen_chains_are_1000_of_five_of_34_tasks():
    chains = results.benchmark_chains()
    assert len(chains) == 1000
    assert {len(chain) for chain in chains} == {5}
    assert len({task for chain in chains for task in chain}) == 34
