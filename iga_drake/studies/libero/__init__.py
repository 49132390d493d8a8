"""LIBERO-PRO's pick-and-place tasks in MuJoCo, done by an aligner from a few demonstrations.

Nothing in this package imports Drake: it runs in an environment of its own, in which LIBERO-PRO is
installed (docs/libero.md). `benchmark.py` alone imports LIBERO-PRO, when a scene is made.
"""
