"""Benchmarks: timings and comparisons with other solvers, for the tables of docs/benchmarks.md.

`python -m scripts.benchmarks` lists them.
"""
