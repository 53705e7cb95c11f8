"""Trains as agents that learn: ``vector.VectorTrains`` for Gymnasium, ``parallel.ParallelTrains`` for PettingZoo.

Both need ``pip install trainctl[environment]``.
"""
