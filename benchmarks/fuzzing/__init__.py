"""Targets of the fuzzer `benchmarks/fuzz.py`.

`cases` runs one case and applies the oracle; `values` mutates texts, trees and bytes; `samples` holds the valid files
that cases start from; the other modules hold the targets by the kind of input, listed in `targets`. Every random choice
comes from the case's `random.Random`, which is seeded by (seed, target name, case number): renaming a target or
reordering its random choices changes its cases.
"""
