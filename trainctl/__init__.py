"""Closed-loop testbed for cooperative train control on real rail networks, over SUMO."""
