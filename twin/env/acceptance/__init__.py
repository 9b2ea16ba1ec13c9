"""Is it a Husky? The acceptance table of the model, measured by wheel commands and `mj_step` alone.

`drive` records drives, `grounds` makes ground, `plane` and `ground` measure rows, `table` holds them all. Tests and
`benchmarks/husky.py` read the same rows.
"""
