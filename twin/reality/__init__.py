"""The known-truth world: a campus road, generated, filmed like a real place, and driven in as the real test.

Nothing outside this folder, `twin/reality/comparison.py` and the tests may read its truth.
"""
