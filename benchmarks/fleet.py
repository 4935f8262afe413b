"""Outlying robots of simulated fleets: how many are found, how many ordinary ones are called so.

`python -m benchmarks.fleet` prints a table. Fleets of 300 robots with 30 parameters; outlying robots are so many
standard deviations (between robots) off in one parameter, or 0.6 times as many in four.
"""

import argparse

import numpy as np

from fixtures.fleets import simulated_fleet
from robcal.fleet.statistics import Member, fleet


def rates(size: float, fleets: int, robots: int, seed: int) -> tuple[float, float]:
    """Share of outlying robots that are found, and of ordinary ones that are called outlying."""
    found = false = outlying = ordinary = 0
    for k in range(fleets):
        names, simulated = simulated_fleet(np.random.default_rng([seed, k]), robots, size=size)
        told = {
            o.name for o in fleet([Member(r.name, names, r.values, r.covariance, r.batch) for r in simulated]).outliers
        }
        found += sum(r.outlying and r.name in told for r in simulated)
        false += sum(not r.outlying and r.name in told for r in simulated)
        outlying += sum(r.outlying for r in simulated)
        ordinary += sum(not r.outlying for r in simulated)
    return found / outlying, false / ordinary


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fleets", type=int, default=10)
    parser.add_argument("--robots", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    print("| off by (sigma) | found | false |\n|---|---|---|")
    for size in (4.0, 5.0, 6.0, 7.0, 8.0):
        found, false = rates(size, given.fleets, given.robots, given.seed)
        print(f"| {size:g} | {100 * found:.1f} % | {100 * false:.2f} % |")


if __name__ == "__main__":
    main()
