"""Simulated drives and measurements of the method."""
