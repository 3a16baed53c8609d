#!/usr/bin/env -S sh -c '"${0%/*}"/setup_venv mpi,test && exec "${0%/*}"/../.venv/bin/python "$0" "$@"'
"""Damage files of a run at random, resume it, and count what becomes of it: a table in Markdown.

    scripts/fuzz.py [CASES] [FIRST]

Each case damages a checkpoint, both of them, the config, the scene or a mesh, seeded by its number. Allowed are a
refusal with one line that leaves everything as it was, and the very bits of the undisturbed run. Exits with 1 if
anything else happened.
"""

import argparse
import collections
import sys
import tempfile
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / folder) for folder in (".", "tests")]

from fuzzing import TARGETS, Outcome, Rig  # noqa: E402

VERDICTS = ("refused", "another", "recovered", "the same", "wrong")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="?", type=int, default=500, help="how many (500)")
    parser.add_argument("first", nargs="?", type=int, default=0, help="number of the first (0)")
    arguments = parser.parse_args()
    cases, first = arguments.cases, arguments.first
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        rig = Rig(Path(folder))
        for number in range(first, first + cases):
            outcomes.append(rig.case(number))
            if outcomes[-1].verdict.startswith("wrong"):
                print(f"case {number}: {outcomes[-1]}", flush=True)
    counts = collections.Counter((o.target, o.verdict.partition(":")[0]) for o in outcomes)
    print("| damaged | unreadable: refused | another run's: refused | recovered, told | same bits | wrong |")
    print("|---|---|---|---|---|---|")
    for target in TARGETS:
        print(f"| {target} | " + " | ".join(str(counts[target, verdict]) for verdict in VERDICTS) + " |")
    print(f"\n{cases} cases, the slowest took {max(o.seconds for o in outcomes):.1f} s")
    return int(any(o.verdict.startswith("wrong") for o in outcomes))


if __name__ == "__main__":
    raise SystemExit(main())
